"""The brick volume: a TSDF whose memory follows the surface. Kernels: volume.cl, layout: include/volume.clh.

Space is a regular grid of bricks of 8x8x8 voxels; a brick gets a slot of the pool when a measured surface comes
near it. Beyond the budget, bricks out of view move to the host, least recently used first, and return unchanged when a
camera sees them again. Meanwhile they still block rays, as cells of 2x2x2 voxels.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from typing import Any

import numpy as np
import pyopencl.array as cl_array
from numpy.typing import NDArray

from protocol.frames import CameraModel
from server.input.measure import intrinsics
from server.maths.rigid import translation
from server.opencl.buffers import BufferDescription, StageBuffers
from server.opencl.engine import Engine, KernelArgument, float16, int4
from server.opencl.structs import VOLUME_SHAPE
from server.opencl.transfer import fill_bytes
from server.volume.brick_pool import BRICK_VOXELS
from server.volume.brick_residency import Residency
from server.volume.brick_table import BRICK, Indices
from server.volume.bricks import Bricks, unpack_bricks
from server.volume.ray_tables import RayTables

__all__ = ["BRICK", "BRICK_VOXELS", "TRUNCATION_VOXELS", "Bricks", "Volume", "VolumeSizeError"]

TRUNCATION_VOXELS = 4.0
_GREATEST_BRICKS = 1 << 22
_TILE = 4


class _Buffers(StageBuffers):
    wanted_bricks = BufferDescription(np.uint8)
    """[brick] 1 for bricks near the measured surface."""


class VolumeSizeError(ValueError):
    """The requested volume is empty or too fine; one line with a remedy."""


class Volume:
    """TSDF of one session. World axes; volume space has its origin at the volume's lower corner.

    `budget_bytes` is device memory of the pool (default: what the device gives a volume), `host_budget_bytes` (default
    four times that) of released bricks.
    """

    def __init__(
        self,
        engine: Engine,
        bounds_m: tuple[float, float, float, float, float, float],
        voxel_m: float,
        budget_bytes: int | None = None,
        host_budget_bytes: int | None = None,
    ) -> None:
        self.bounds_m = bounds_m
        self.origin_world = np.array(bounds_m[:3], np.float64)
        self.voxel_m = float(voxel_m)
        self.bricks = _brick_counts(np.array(bounds_m[3:]) - self.origin_world, self.voxel_m)
        self.truncation_m = TRUNCATION_VOXELS * self.voxel_m
        self.frames = 0
        self.is_full = False
        self._engine, self._buffers = engine, _Buffers(engine.workspace)
        self._tables = RayTables(engine, self.bricks)
        budget_bytes = engine.device.volume_bytes if budget_bytes is None else budget_bytes
        host_bytes = 4 * budget_bytes if host_budget_bytes is None else host_budget_bytes
        self._residency = Residency(engine, self._tables, self.voxel_m, budget_bytes, host_bytes)
        self._tables.update()

    @property
    def voxels(self) -> cl_array.Array:
        """[slots, 512] float2 (tsdf, weight); another array after the pool has grown."""
        return self._residency.pool.voxels

    @property
    def colors(self) -> cl_array.Array:
        """[slots, 512] uint32 packed colour, see bricks.py; 0 = none. Another array after the pool has grown."""
        return self._residency.pool.colors

    @property
    def octets(self) -> cl_array.Array:
        """[slots, 64] uint8, see volume.clh. Another array after the pool has grown."""
        return self._residency.pool.octets

    @property
    def solid(self) -> cl_array.Array:
        """[z, y, x] uint64, see volume.clh."""
        return self._tables.solid

    @property
    def slots_device(self) -> cl_array.Array:
        """[z, y, x] int32 slot of each brick, AWAY_SLOT, or NO_SLOT."""
        return self._residency.slots_device

    @property
    def allocated_device(self) -> cl_array.Array:
        """[allocated_bricks and more] int32: the bricks that have a slot of their own, in the order of the slots."""
        return self._residency.resident_device

    @property
    def allocated_bricks(self) -> int:
        """Bricks that have a slot of their own."""
        return self._residency.resident_count

    @property
    def released_bricks(self) -> int:
        """Bricks that the host keeps."""
        return len(self._residency.store)

    @property
    def capacity(self) -> int:
        """Bricks that the pool has slots for now; it grows up to the budget."""
        return self._residency.pool.capacity

    @property
    def device_bytes(self) -> int:
        """Device memory of the voxels and of all tables."""
        return self._residency.device_bytes + self._tables.bytes_held

    @property
    def host_bytes(self) -> int:
        """Host memory of the released bricks."""
        return self._residency.store.bytes_held

    def count_frame(self) -> None:
        """Say that one more picture was integrated."""
        self.frames += 1

    def note_picture(self, camera: CameraModel, volume_from_camera: NDArray[np.float64]) -> None:
        """Say where a picture was taken whose integration may have changed bricks."""
        self._residency.note_picture(camera, volume_from_camera)

    @property
    def changes(self) -> int:
        """Grows whenever voxels change."""
        return self._residency.changes

    def places(self) -> Indices:
        """[n] all bricks that hold voxels, released ones too: their places in the grid, x fastest, in order."""
        return self._residency.held()

    def changed_since(self, change: int) -> Indices:
        """[n] those of `places` whose voxels may have changed after `changes` was `change`; -1: all."""
        return self._residency.changed_since(change)

    def copies(self, places: Indices) -> Iterator[tuple[Indices, NDArray[Any], NDArray[np.uint32]]]:
        """The bricks at `places`, bit for bit, some at a time: places [k], voxels [k, 512] float2, colours [k, 512]."""
        return self._residency.copies(places)

    def fill(self, batches: Iterable[tuple[Indices, NDArray[Any], NDArray[np.uint32]]], frames: int) -> None:
        """Make an empty volume one of which these are the `copies`, after `frames` pictures."""
        for places, voxels, colors in batches:
            self._residency.fill(places, voxels, colors)
        self.frames = frames
        self._tables.update()

    def volume_from_world(self) -> NDArray[np.float64]:
        """4x4 that moves world coordinates to the volume's origin."""
        return translation(-self.origin_world)

    def arguments(self) -> tuple[KernelArgument, ...]:
        """VOLUME_PARAMETERS of include/volume.clh."""
        return self.shape, self.slots_device, self._tables.memory, self.octets, self.voxels

    @property
    def shape(self) -> np.void:
        """VolumeShape of structs.py."""
        return VOLUME_SHAPE(
            bricks=int4(*self.bricks, 0),
            voxel_m=self.voxel_m,
            truncation_m=self.truncation_m,
            gaps_at=self._tables.gaps_at,
        )

    def allocate(self, camera: CameraModel, volume_from_camera: NDArray[np.float64], depth_m: cl_array.Array) -> None:
        """Give a slot to every brick near the measured surface, and bring back what the camera sees.

        Where the budget has no room for all of them, the ones nearest the camera win, and `is_full` says so.
        """
        wanted = self._mark(camera, volume_from_camera, depth_m)
        self._residency.begin_frame(wanted)
        self.is_full = not self._residency.provide(camera, volume_from_camera, wanted)

    def bring_back(self, camera: CameraModel, volume_from_camera: NDArray[np.float64]) -> None:
        """Bring back released bricks that a camera sees, before casting rays from where nothing is measured."""
        self._residency.provide(camera, volume_from_camera, np.empty(0, np.int32))

    def update_tables(self) -> None:
        """Renew the tables for empty-space skipping, after integration has changed the solid cells."""
        self._tables.update()

    def download_batches(self) -> Iterator[Bricks]:
        """All bricks that hold voxels, released ones too, some at a time."""
        for places, voxels, colors in self._residency.everything():
            yield unpack_bricks(places, voxels, colors)

    def download_bricks(self) -> Bricks:
        """All bricks that hold voxels, released ones too."""
        return Bricks.joined(list(self.download_batches()))

    def _mark(self, camera: CameraModel, volume_from_camera: NDArray[np.float64], depth_m: cl_array.Array) -> Indices:
        wanted = self._buffers.wanted_bricks.array((self.solid.size,))
        fill_bytes(self._engine.queue, wanted, 0)
        self._engine.launch(
            self._engine.kernel("volume.cl", "mark_bricks"),
            (-(-camera.width // _TILE), -(-camera.height // _TILE)),
            camera.width,
            camera.height,
            int4(*self.bricks, 0),
            depth_m,
            intrinsics(camera),
            float16(volume_from_camera),
            self.voxel_m,
            self.truncation_m + self.voxel_m,
            wanted,
        )
        return np.flatnonzero(self._engine.download(wanted).view(np.bool_)).astype(np.int32)


def _brick_counts(extent_m: NDArray[np.float64], voxel_m: float) -> tuple[int, int, int]:
    """Bricks along x, y, z. Raises VolumeSizeError."""
    counts = np.ceil(extent_m / (BRICK * voxel_m) - 1e-6)  # floats: their product does not overflow
    if (extent_m <= 0).any() or counts.prod() > _GREATEST_BRICKS:
        raise VolumeSizeError(
            f"a volume of {extent_m[0]:.2f} x {extent_m[1]:.2f} x {extent_m[2]:.2f} m at {1e3 * voxel_m:.1f} mm "
            f"a voxel has {counts.prod():.0f} bricks, at most {_GREATEST_BRICKS}: give a larger --voxel"
        )
    x, y, z = counts.astype(np.int64).tolist()
    return x, y, z
