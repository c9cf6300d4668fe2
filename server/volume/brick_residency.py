"""Residency of bricks: those that the camera needs are on the device, others as far as the budget allows."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from protocol.frames import CameraModel
from server.opencl.buffers import BufferDescription, StageBuffers
from server.opencl.engine import Engine
from server.volume.brick_pool import BRICK_BYTES, BRICK_CELLS, BRICK_VOXELS, BrickPool, upload_list
from server.volume.brick_store import BrickStore
from server.volume.brick_table import AWAY_SLOT, NO_SLOT, BrickTable, Indices, in_view
from server.volume.ray_tables import RayTables

_VOXEL_BYTES = 12
_FIRST_CAPACITY = 4096
_GROWTH = 1.25
_IDLE_FRAMES = 32
"""A brick without surface in or near it is freed when no frame has requested it for this long."""
_SETTLING_FRAMES = 8
"""Interval between searches for such bricks."""
_SPARE_SHARE = 1 / 16
"""Share of the budget that is released in addition, so that not every frame has to release bricks."""


class _Buffers(StageBuffers):
    slots = BufferDescription(np.int32)
    """[z, y, x] slot of each brick, AWAY_SLOT, or NO_SLOT."""
    listed_bricks = BufferDescription(np.int32)
    """[n or more] resident ones in the order of their slots, then those that got another slot last, and these slots."""
    restored_bricks = BufferDescription(np.int32)
    """[n or more]"""


class Residency:
    """Allocates and frees slots of the pool."""

    def __init__(self, engine: Engine, tables: RayTables, voxel_m: float, budget_bytes: int, host_bytes: int) -> None:
        self._engine, self._buffers = engine, _Buffers(engine.workspace)
        self._tables = tables
        self._voxel_m = voxel_m
        self._table = BrickTable(tables.bricks)
        self._frame = 0
        self.limit = min(self._table.slots.size, budget_bytes // BRICK_BYTES)
        """Most bricks on the device."""
        self.pool = BrickPool(engine)
        self.store = BrickStore(host_bytes // (_VOXEL_BYTES * BRICK_VOXELS))
        self.slots_device = self._buffers.slots.upload(self._table.slots)
        self.resident_device = upload_list(engine, self._buffers.listed_bricks, self._table.resident())
        self.resident_count = 0
        self.changes = 0
        """Number of changes of voxels so far."""
        self._changed = np.zeros(self._table.slots.size, np.int64)
        self._requested = np.empty(0, np.int32)

    @property
    def device_bytes(self) -> int:
        """Device memory of the pool and the table."""
        return self.pool.bytes_held + int(self.slots_device.nbytes)

    def begin_frame(self, requested: Indices) -> None:
        """Note which bricks are near the surface that the frame measures."""
        self._frame += 1
        self._requested = requested
        self._table.touch(requested, self._frame)
        if self._frame % _SETTLING_FRAMES == 0:
            self._free_idle()

    def provide(self, camera: CameraModel, volume_from_camera: NDArray[np.float64], requested: Indices) -> bool:
        """Slots for requested bricks and for released ones in view; False if only the nearest ones got a slot."""
        slots, away = self._table.slots_of(requested), self.store.indices()
        back = np.union1d(away[self._in_view(camera, volume_from_camera, away)], requested[slots == AWAY_SLOT])
        missing = np.concatenate([back, requested[slots == NO_SLOT]]).astype(np.int32)
        if not missing.size:
            return True
        self._make_room(len(missing), len(back), camera, volume_from_camera, requested)
        room = self._free_slots()
        if room < len(missing):
            distance = np.linalg.norm(self._table.in_camera(missing, volume_from_camera, self._voxel_m), axis=-1)
            chosen = np.sort(np.argsort(distance, kind="stable")[:room])
        else:
            chosen = np.arange(len(missing))
        self._restore(missing[chosen[chosen < len(back)]])
        self._claim(missing[chosen[chosen >= len(back)]])
        return room >= len(missing)

    def note_picture(self, camera: CameraModel, volume_from_camera: NDArray[np.float64]) -> None:
        """Mark bricks as changed by a frame that was integrated: those in view, and those it requested."""
        resident = self._table.resident()
        self._note_change(resident[self._in_view(camera, volume_from_camera, resident)])
        self._changed[self._requested] = self.changes

    def forget_colors(self, share: float) -> None:
        """Take `share` of their weight from the colours of all bricks."""
        self.pool.forget_colors(share)
        self.store.forget_colors(share)
        self._note_change(self.existing())

    def existing(self) -> Indices:
        """All bricks with voxels, including released ones, sorted."""
        return np.sort(np.concatenate([self._table.resident(), self.store.indices()]))

    def changed_since(self, change: int) -> Indices:
        """Existing bricks that may have changed since `changes` had this value; -1: all."""
        bricks = self.existing()
        return bricks[self._changed[bricks] > change]

    def copies(self, bricks: Indices) -> Iterator[tuple[Indices, NDArray[Any], NDArray[np.uint32]]]:
        """Existing bricks in batches, resident ones first: indices, voxels [k, 512] float2, colours [k, 512]."""
        slots = self._table.slots_of(bricks)
        resident = bricks[slots > AWAY_SLOT]
        for batch, voxels, colors in self.pool.download(self._table.slots_of(resident)):
            yield resident[batch], voxels, colors
        yield from self.store.batches(bricks[slots == AWAY_SLOT])

    def fill(self, bricks: Indices, voxels: NDArray[Any], colors: NDArray[np.uint32]) -> None:
        """Add bricks that do not exist yet: voxels [n, 512] float2, colours [n, 512]. They count as unchanged.

        Earlier ones are released to make room, even beyond the host's budget.
        """
        for start in range(0, len(bricks), max(self.limit, 1)):
            some = slice(start, start + max(self.limit, 1))
            self.store.put(bricks[some], voxels[some], colors[some])
            self._table.leave(bricks[some], AWAY_SLOT)
            self._grow(self.resident_count + len(bricks[some]))
            short = len(bricks[some]) - self._free_slots()
            if short > 0:
                self._release(self._table.resident()[:short])
            self._restore(bricks[some])

    def batches(self) -> Iterator[tuple[Indices, NDArray[Any], NDArray[np.uint32]]]:
        """All bricks in batches: coordinates [k, 3], voxels [k, 512] float2, colours [k, 512]."""
        resident = self._table.resident()
        for batch, voxels, colors in self.pool.download(self._table.slots_of(resident)):
            yield self._table.coordinates(resident[batch]), voxels, colors
        for chosen, voxels, colors in self.store.batches():
            yield self._table.coordinates(chosen), voxels, colors

    def _note_change(self, bricks: Indices) -> None:
        self.changes += 1
        self._changed[bricks] = self.changes

    def _free_slots(self) -> int:
        return self.pool.capacity - self.resident_count

    def _in_view(self, camera: CameraModel, pose: NDArray[np.float64], bricks: Indices) -> NDArray[np.bool_]:
        return in_view(camera, self._table.in_camera(bricks, pose, self._voxel_m), self._voxel_m)

    def _make_room(
        self,
        count: int,
        returning: int,
        camera: CameraModel,
        volume_from_camera: NDArray[np.float64],
        requested: Indices,
    ) -> None:
        """Try to get `count` free slots: by growing, else by releasing bricks out of view."""
        self._grow(self.resident_count + count)
        short = count - self._free_slots()
        host_room = self.store.room + returning  # these leave the host in the same step
        if short <= 0 or host_room <= 0:
            return
        resident = self._table.resident()
        unseen = resident[~self._in_view(camera, volume_from_camera, resident) & ~np.isin(resident, requested)]
        order = np.argsort(self._table.last_requested(unseen), kind="stable")
        self._release(unseen[order[: min(short + int(_SPARE_SHARE * self.limit), host_room)]])

    def _grow(self, count: int) -> None:
        steps = max(count, int(_GROWTH * self.pool.capacity), _FIRST_CAPACITY)
        capacity = min(steps, self.limit)
        if count > self.pool.capacity and capacity > self.pool.capacity:
            self.pool.grow(capacity)
            self._table.grow(capacity)

    def _claim(self, bricks: Indices) -> None:
        self._table.take(bricks)
        self._note_change(bricks)
        self._place(bricks, clears=True)

    def _restore(self, bricks: Indices) -> None:
        if not bricks.size:
            return
        self.pool.upload(self._table.take(bricks), *self.store.take(bricks))
        self._place(bricks)
        listed = upload_list(self._engine, self._buffers.restored_bricks, bricks)
        self._tables.find_solid(listed, len(bricks), self.slots_device, self.pool)

    def _release(self, bricks: Indices) -> None:
        for batch, voxels, colors in self.pool.download(self._table.slots_of(bricks)):
            self.store.put(bricks[batch], voxels, colors)
        self._table.leave(bricks, AWAY_SLOT)
        self._place(bricks)

    def _free_idle(self) -> None:
        """Free bricks that noise has requested or whose surface was carved away; the same ones with any budget."""
        before = self._frame - _IDLE_FRAMES
        idle = np.concatenate(
            [self._table.settle(self._table.resident(), before), self._table.settle(self.store.indices(), before)]
        )
        empty = idle[~self._tables.near_solid(idle)]
        self.store.forget(empty[self._table.slots_of(empty) == AWAY_SLOT])
        self._table.leave(empty, NO_SLOT)
        self._place(empty)

    def _place(self, bricks: Indices, *, clears: bool = False) -> None:
        """Copy the new slots of bricks to the device; `clears`: their voxels are never seen."""
        if not bricks.size:
            return
        resident, pool = self._table.resident(), self.pool
        lists = np.concatenate([resident, bricks, self._table.slots_of(bricks)])
        listed = upload_list(self._engine, self._buffers.listed_bricks, lists)
        self._engine.launch(
            self._engine.kernel("brick_pool.cl", "place_bricks"),
            (BRICK_CELLS * len(bricks),),
            len(bricks),
            clears,
            len(resident),
            listed,
            self.slots_device,
            self._tables.solid,
            pool.voxels,
            pool.colors,
        )
        self.resident_device, self.resident_count = listed, len(resident)
