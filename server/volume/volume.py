"""The brick volume: a TSDF whose memory follows the surface. Kernels: volume.cl, layout: include/volume.clh.

Space is a regular grid of bricks of 8x8x8 voxels. A brick gets a slot of the pool when a measured surface is near it.
Beyond the budget, bricks out of view move to the host, least recently used first, and return unchanged when a camera
sees them again. Meanwhile they still block rays, as cells of 2x2x2 voxels.
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
from server.opencl.engine import Engine, KernelArgument, float16, int4
from server.opencl.pending_read import PendingRead
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


class VolumeSizeError(ValueError):
    """The requested volume is empty or too fine; one line that says what to change."""


class Volume:
    """TSDF of one scene. Volume space has world axes and its origin at the volume's lower corner.

    `budget_bytes`: device memory of the pool (default: the device's limit for a volume). `host_budget_bytes`: host
    memory of released bricks (default: four times that).
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
        self._engine = engine
        self._tables = RayTables(engine, self.bricks)
        budget_bytes = engine.device.volume_bytes if budget_bytes is None else budget_bytes
        host_bytes = 4 * budget_bytes if host_budget_bytes is None else host_budget_bytes
        self._residency = Residency(engine, self._tables, self.voxel_m, budget_bytes, host_bytes)
        self.update_tables()

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
        """[allocated_bricks or more] int32: indices of the bricks with a slot, in the order of the slots."""
        return self._residency.resident_device

    @property
    def allocated_bricks(self) -> int:
        """Bricks with a slot of the pool."""
        return self._residency.resident_count

    @property
    def released_bricks(self) -> int:
        """Bricks on the host."""
        return len(self._residency.store)

    @property
    def capacity(self) -> int:
        """Slots of the pool; it grows up to the budget."""
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
        """Count an integrated frame."""
        self.frames += 1

    def note_picture(self, camera: CameraModel, volume_from_camera: NDArray[np.float64]) -> None:
        """Mark bricks as changed by the integration of a frame from this pose."""
        self._residency.note_picture(camera, volume_from_camera)

    def forget_colors(self, share: float) -> None:
        """Take `share` of their weight from all colours, since the light has changed: the next pictures count more."""
        self._residency.forget_colors(share)
        self.written = self._engine.mark()

    @property
    def changes(self) -> int:
        """Increases whenever voxels change."""
        return self._residency.changes

    def places(self) -> Indices:
        """[n] indices in the grid (x fastest, sorted) of all bricks with voxels, including released ones."""
        return self._residency.existing()

    def changed_since(self, change: int) -> Indices:
        """[n] those of `places` that may have changed since `changes` was `change`; -1: all."""
        return self._residency.changed_since(change)

    def copies(self, places: Indices) -> Iterator[tuple[Indices, NDArray[Any], NDArray[np.uint32]]]:
        """The bricks at `places` in batches, bit for bit: places [k], voxels [k, 512] float2, colours [k, 512]."""
        return self._residency.copies(places)

    def fill(self, batches: Iterable[tuple[Indices, NDArray[Any], NDArray[np.uint32]]], frames: int) -> None:
        """Fill an empty volume with the `copies` of another one that has integrated `frames` frames."""
        for places, voxels, colors in batches:
            self._residency.fill(places, voxels, colors)
        self.frames = frames
        self.update_tables()

    def volume_from_world(self) -> NDArray[np.float64]:
        """[4, 4] translation to the volume's origin."""
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

    def allocate(
        self,
        camera: CameraModel,
        volume_from_camera: NDArray[np.float64],
        depth_m: cl_array.Array,
        marked: PendingRead | None = None,
    ) -> None:
        """Give a slot to every brick near the measured surface, and restore released bricks in view.

        If the budget has no room for all of them, the ones nearest to the camera get a slot and `is_full` is set.
        marked: of `mark_near` for the same arguments; None: they are marked here.
        """
        marked = marked or self.mark_near(camera, volume_from_camera, depth_m)
        bricks = np.flatnonzero(marked.result().view(np.bool_)).astype(np.int32)
        self._residency.begin_frame(bricks)
        self.is_full = not self._residency.provide(camera, volume_from_camera, bricks)
        self.written = self._engine.mark()

    def bring_back(self, camera: CameraModel, volume_from_camera: NDArray[np.float64]) -> None:
        """Restore released bricks in view. Needed before ray casting from a pose without a measurement."""
        self._residency.provide(camera, volume_from_camera, np.empty(0, np.int32))
        self.written = self._engine.mark()

    def update_tables(self) -> None:
        """Renew the tables for empty-space skipping, after integration has changed the solid cells."""
        self._tables.update()
        self.written = self._engine.mark()
        """Event after which its memory is what it was asked to become; for other queues."""

    def download_batches(self) -> Iterator[Bricks]:
        """All bricks with voxels in batches, including released ones."""
        for places, voxels, colors in self._residency.batches():
            yield unpack_bricks(places, voxels, colors)

    def download_bricks(self) -> Bricks:
        """All bricks with voxels, including released ones."""
        return Bricks.joined(list(self.download_batches()))

    def mark_near(
        self, camera: CameraModel, volume_from_camera: NDArray[np.float64], depth_m: cl_array.Array
    ) -> PendingRead:
        """[bricks] uint8, on its way: 1 for those near the measured surface."""
        marked = self._engine.array_to_read((self.solid.size,), np.uint8)
        fill_bytes(self._engine.queue, marked, 0)
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
            marked,
        )
        return self._engine.begin_download(marked)


def _brick_counts(extent_m: NDArray[np.float64], voxel_m: float) -> tuple[int, int, int]:
    """Bricks along x, y, z. Raises VolumeSizeError."""
    size = f"a volume of {' x '.join(f'{side:.2f}' for side in extent_m)} m at {1e3 * voxel_m:.1f} mm a voxel"
    if not (np.isfinite(extent_m) & (extent_m > 0)).all():
        raise VolumeSizeError(f"{size} has a side that is not above 0: check the volume's bounds, or pose and depth")
    counts = np.ceil(extent_m / (BRICK * voxel_m) - 1e-6).clip(1)  # floats: their product does not overflow
    if counts.prod() > _GREATEST_BRICKS:
        raise VolumeSizeError(
            f"{size} has {counts.prod():.6g} bricks, at most {_GREATEST_BRICKS}: give a larger --voxel"
        )
    x, y, z = counts.astype(np.int64).tolist()
    return x, y, z
