"""The brick volume: a TSDF whose memory follows the surface. Kernels: volume.cl, layout: include/volume.clh.

Space is a regular grid of bricks of 8x8x8 voxels; a brick gets a slot of the pool when a measured
surface comes near it.
"""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pyopencl.array as cl_array
import pyopencl.cltypes as cl_types
from numpy.typing import NDArray

from protocol.frames import CameraModel
from server.maths.rigid import translation
from server.opencl.engine import Engine, KernelArgument, float16, int4
from server.stages.measure import intrinsics

BRICK = 8
BRICK_VOXELS = BRICK**3
TRUNCATION_VOXELS = 4.0
_GREATEST_GAP = 15
_GREATEST_BRICKS = 1 << 22


class VolumeSizeError(ValueError):
    """The asked volume is empty or too fine; one line that says what to do."""


class Volume:
    """TSDF of one session. World axes; volume space has its origin at the volume's lower corner."""

    def __init__(
        self,
        engine: Engine,
        bounds_m: tuple[float, float, float, float, float, float],
        voxel_m: float,
        budget_bytes: int = 512 << 20,
    ) -> None:
        self.origin_world = np.array(bounds_m[:3], np.float64)
        self.voxel_m = float(voxel_m)
        extent = np.array(bounds_m[3:]) - self.origin_world
        counts = np.ceil(extent / (BRICK * self.voxel_m) - 1e-6)  # floats: their product does not overflow
        if (extent <= 0).any() or counts.prod() > _GREATEST_BRICKS:
            raise VolumeSizeError(
                f"a volume of {extent[0]:.2f} x {extent[1]:.2f} x {extent[2]:.2f} m at {1e3 * self.voxel_m:.1f} mm "
                f"a voxel has {counts.prod():.0f} bricks, at most {_GREATEST_BRICKS}: give a larger --voxel"
            )
        counts = counts.astype(np.int64)
        self.bricks = (int(counts[0]), int(counts[1]), int(counts[2]))
        self.truncation_m = TRUNCATION_VOXELS * self.voxel_m
        self.capacity = int(min(counts.prod(), budget_bytes // (8 * BRICK_VOXELS)))
        self.is_full = False
        self._engine = engine
        self._slots = np.full(counts[::-1], -1, np.int32)
        self._allocated = np.empty(0, np.int32)
        space = engine.workspace
        self.voxels: cl_array.Array = space.array("voxels", (self.capacity, BRICK_VOXELS), cl_types.float2)
        self.voxels.fill(np.zeros((), cl_types.float2))
        self._solid = space.array("brick_solid", self._slots.shape, np.uint64)
        self._solid.fill(np.uint64(0))
        self._octets = space.array("solid_octets", (self.capacity, 64), np.uint8)
        self._gaps = space.array("brick_gaps", (8 * self._slots.size,), np.uint8)
        self._upload_table()
        self.summarize()

    @property
    def allocated_bricks(self) -> int:
        """Bricks that hold voxels."""
        return len(self._allocated)

    def volume_from_world(self) -> NDArray[np.float64]:
        """4x4 that moves world coordinates to the volume's origin."""
        return translation(-self.origin_world)

    def arguments(self) -> tuple[KernelArgument, ...]:
        """What make_volume of include/volume.clh takes, in its order."""
        return (
            int4(*self.bricks, 0),
            self.slots_device,
            self._gaps,
            self._solid,
            self._octets,
            self.voxels,
            self.voxel_m,
            self.truncation_m,
        )

    def allocate(self, camera: CameraModel, volume_from_camera: NDArray[np.float64], depth_m: cl_array.Array) -> None:
        """Give a slot to every brick near the measured surface; past the budget the nearest table order wins."""
        wanted = self._engine.workspace.array("wanted_bricks", self._slots.shape, np.uint8)
        wanted.fill(np.uint8(0))
        self._engine.launch(
            self._engine.kernel("volume.cl", "mark_bricks"),
            (camera.width, camera.height),
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
        new = np.flatnonzero((self._engine.download(wanted) != 0).ravel() & (self._slots.ravel() < 0)).astype(np.int32)
        room = self.capacity - len(self._allocated)
        self.is_full = len(new) > room
        new = new[:room]
        if new.size:
            self._slots.ravel()[new] = np.arange(len(self._allocated), len(self._allocated) + len(new))
            self._allocated = np.concatenate([self._allocated, new])
            self._upload_table()

    def summarize(self) -> None:
        """After integration: find the solid cells and how far rays may jump between them."""
        space, bricks = self._engine.workspace, int4(*self.bricks, 0)
        if self.allocated_bricks:
            self._engine.launch(
                self._engine.kernel("volume.cl", "find_solid"),
                (64 * self.allocated_bricks,),
                self.allocated_bricks,
                self.allocated_device,
                self.slots_device,
                self.voxels,
                self._solid,
                self._octets,
            )
        count = self._slots.size
        gaps = [space.array(f"gaps_{i}", (variants * count,), np.uint8) for i, variants in enumerate((1, 2, 4))]
        self._engine.launch(
            self._engine.kernel("volume.cl", "start_gaps"), (count,), count, self._solid, _GREATEST_GAP, gaps[0]
        )
        for axis, (inner, outer) in enumerate(pairwise([*gaps, self._gaps])):
            self._engine.launch(
                self._engine.kernel("volume.cl", "gap_along_axis"),
                (self.bricks[0], self.bricks[1], self.bricks[2] * (2 << axis)),
                bricks,
                1 << axis,
                inner,
                axis,
                _GREATEST_GAP,
                outer,
            )

    def _upload_table(self) -> None:
        """Bring slots and the list of allocated bricks to the device."""
        space = self._engine.workspace
        self.slots_device = space.upload("brick_slots", self._slots)
        self.allocated_device = space.upload("allocated_bricks", self._allocated) if self._allocated.size else None
