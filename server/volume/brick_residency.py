"""Residency of bricks: those that a camera needs now are on the device, and others as far as the budget allows."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from protocol.frames import CameraModel
from server.opencl.buffers import BufferDescription, StageBuffers
from server.opencl.engine import Engine
from server.volume.brick_pool import BRICK_BYTES, BRICK_VOXELS, BrickPool, upload_list
from server.volume.brick_store import BrickStore
from server.volume.brick_table import AWAY_SLOT, NO_SLOT, BrickTable, Indices, in_view
from server.volume.ray_tables import RayTables

_VOXEL_BYTES = 12
_FIRST_CAPACITY = 4096
_GROWTH = 1.25
_IDLE_FRAMES = 32
"""A brick that was not wanted for so long, and has no surface in it or near it, is given back."""
_SETTLING_FRAMES = 8
"""How often bricks are looked through for those."""
_SPARE_SHARE = 1 / 16
"""Part of the budget that is released beyond what is asked, so that not every frame has to."""


class _Buffers(StageBuffers):
    slots = BufferDescription(np.int32)
    """[z, y, x] slot of each brick, AWAY_SLOT, or NO_SLOT."""
    resident_bricks = BufferDescription(np.int32)
    """[n or more] in the order of their slots."""
    restored_bricks = BufferDescription(np.int32)
    """[n or more]"""
    placed_bricks = BufferDescription(np.int32)
    """[n or more] bricks that get another slot."""
    placed_slots = BufferDescription(np.int32)
    """[n or more] their slots."""


class Residency:
    """Allocates and frees slots of the pool."""

    def __init__(self, engine: Engine, tables: RayTables, voxel_m: float, budget_bytes: int, host_bytes: int) -> None:
        self._engine, self._buffers = engine, _Buffers(engine.workspace)
        self._tables = tables
        self._voxel_m = voxel_m
        self._table = BrickTable(tables.bricks)
        self._frame = 0
        self.limit = min(self._table.slots.size, budget_bytes // BRICK_BYTES)
        """Bricks that the budget has room for."""
        self.pool = BrickPool(engine)
        self.store = BrickStore(host_bytes // (_VOXEL_BYTES * BRICK_VOXELS))
        self.slots_device = self._buffers.slots.upload(self._table.slots)
        self.resident_device = upload_list(engine, self._buffers.resident_bricks, self._table.resident())
        self.resident_count = 0
        self.changes = 0
        """Counts what changes bricks' voxels."""
        self._changed = np.zeros(self._table.slots.size, np.int64)
        self._wanted = np.empty(0, np.int32)

    @property
    def device_bytes(self) -> int:
        """Device memory of the pool and the table."""
        return self.pool.bytes_held + int(self.slots_device.nbytes)

    def begin_frame(self, wanted: Indices) -> None:
        """Note which bricks the newest picture wants."""
        self._frame += 1
        self._wanted = wanted
        self._table.touch(wanted, self._frame)
        if self._frame % _SETTLING_FRAMES == 0:
            self._give_back_idle()

    def provide(self, camera: CameraModel, volume_from_camera: NDArray[np.float64], wanted: Indices) -> bool:
        """Slots for wanted bricks and for released ones that the camera sees; False if only the nearest got one."""
        slots, away = self._table.slots_of(wanted), self.store.indices()
        back = np.union1d(away[self._in_view(camera, volume_from_camera, away)], wanted[slots == AWAY_SLOT])
        asked = np.concatenate([back, wanted[slots == NO_SLOT]]).astype(np.int32)
        if not asked.size:
            return True
        self._make_room(len(asked), len(back), camera, volume_from_camera, wanted)
        room = self._free_slots()
        if room < len(asked):
            distance = np.linalg.norm(self._table.in_camera(asked, volume_from_camera, self._voxel_m), axis=-1)
            chosen = np.sort(np.argsort(distance, kind="stable")[:room])
        else:
            chosen = np.arange(len(asked))
        self._restore(asked[chosen[chosen < len(back)]])
        self._claim(asked[chosen[chosen >= len(back)]])
        return room >= len(asked)

    def note_picture(self, camera: CameraModel, volume_from_camera: NDArray[np.float64]) -> None:
        """A picture was integrated: bricks in view, and near what it measured, may have changed."""
        resident = self._table.resident()
        self._note_change(resident[self._in_view(camera, volume_from_camera, resident)])
        self._changed[self._wanted] = self.changes

    def held(self) -> Indices:
        """All bricks that hold voxels, released ones too, in order."""
        return np.sort(np.concatenate([self._table.resident(), self.store.indices()]))

    def changed_since(self, change: int) -> Indices:
        """Those of the bricks held that may have changed after `changes` was that; -1: all."""
        held = self.held()
        return held[self._changed[held] > change]

    def copies(self, bricks: Indices) -> Iterator[tuple[Indices, NDArray[Any], NDArray[np.uint32]]]:
        """Of bricks that are held, in batches and in an order of its own: places, voxels [k, 512] float2, colours."""
        slots = self._table.slots_of(bricks)
        resident = bricks[slots > AWAY_SLOT]
        for batch, voxels, colors in self.pool.download(self._table.slots_of(resident)):
            yield resident[batch], voxels, colors
        yield from self.store.batches(bricks[slots == AWAY_SLOT])

    def fill(self, bricks: Indices, voxels: NDArray[Any], colors: NDArray[np.uint32]) -> None:
        """Take in bricks of which nothing is held: voxels [n, 512] float2, colours [n, 512]. They count as unchanged.

        Earlier ones make room for them; the host takes what the device has no room for, whatever its budget.
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

    def everything(self) -> Iterator[tuple[Indices, NDArray[Any], NDArray[np.uint32]]]:
        """In batches: coordinates [k, 3], voxels [k, 512] float2 and colours [k, 512] of bricks, released ones too."""
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
        self, count: int, returning: int, camera: CameraModel, volume_from_camera: NDArray[np.float64], wanted: Indices
    ) -> None:
        """Try to have `count` free slots: by growing, else by releasing what is not looked at."""
        self._grow(self.resident_count + count)
        short = count - self._free_slots()
        host_room = self.store.room + returning  # these leave the host at once
        if short <= 0 or host_room <= 0:
            return
        resident = self._table.resident()
        unseen = resident[~self._in_view(camera, volume_from_camera, resident) & ~np.isin(resident, wanted)]
        order = np.argsort(self._table.last_wanted(unseen), kind="stable")
        self._release(unseen[order[: min(short + int(_SPARE_SHARE * self.limit), host_room)]])

    def _grow(self, wanted: int) -> None:
        steps = max(wanted, int(_GROWTH * self.pool.capacity), _FIRST_CAPACITY)
        capacity = min(steps, self.limit)
        if wanted > self.pool.capacity and capacity > self.pool.capacity:
            self.pool.grow(capacity)
            self._table.grow(capacity)

    def _claim(self, bricks: Indices) -> None:
        self.pool.clear(self._table.take(bricks))
        self._note_change(bricks)
        self._place(bricks)

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

    def _give_back_idle(self) -> None:
        """Bricks that noise asked for, or whose surface was carved away, with any budget the same ones."""
        before = self._frame - _IDLE_FRAMES
        idle = np.concatenate(
            [self._table.settle(self._table.resident(), before), self._table.settle(self.store.indices(), before)]
        )
        empty = idle[~self._tables.near_solid(idle)]
        self.store.forget(empty[self._table.slots_of(empty) == AWAY_SLOT])
        self._table.leave(empty, NO_SLOT)
        self._place(empty)

    def _place(self, bricks: Indices) -> None:
        """Tell the device the new slots of bricks."""
        if not bricks.size:
            return
        slots = upload_list(self._engine, self._buffers.placed_slots, self._table.slots_of(bricks))
        placed = upload_list(self._engine, self._buffers.placed_bricks, bricks)
        kernel = self._engine.kernel("brick_pool.cl", "place_bricks")
        self._engine.launch(kernel, (len(bricks),), len(bricks), placed, slots, self.slots_device, self._tables.solid)
        resident = self._table.resident()
        self.resident_count = len(resident)
        self.resident_device = upload_list(self._engine, self._buffers.resident_bricks, resident)
