"""What one picture shows of a room: patches of surface of one kind, and what is clipped. Kernel: patches.cl."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import pyopencl.array as cl_array
import pyopencl.cltypes as cl_types
from numpy.typing import NDArray

from protocol.frames import CameraModel
from server.opencl.engine import Engine, float4
from server.volume.raycast import Surface
from server.volume.volume import Volume

LEAST_SHARE = 0.6
"""Least share of a block's pixels that must lie on one surface."""
_BLOCKS_ACROSS = 40  # blocks of pixels along a picture's width
_TOLERANCE_VOXELS = 1.5

Floats = NDArray[np.float64]


def _vectors() -> Floats:
    return np.zeros((0, 3))


@dataclass(frozen=True)
class SeenBright:
    """What one picture shows of clipped surface, block by block, world space. [n] blocks."""

    positions: Floats = field(default_factory=_vectors)
    """[n, 3] metres."""
    normals: Floats = field(default_factory=_vectors)
    """[n, 3] mean, not of unit length."""
    radiance: Floats = field(default_factory=_vectors)
    """[n, 3] mean RGB as clipped."""
    areas_m2: Floats = field(default_factory=lambda: np.zeros(0))
    """[n] across the line of sight."""
    eye: Floats = field(default_factory=lambda: np.zeros(3))
    """[3] of the camera, metres."""


@dataclass(frozen=True)
class Seen:
    """What one picture shows of patches, on the host, world space."""

    positions: Floats
    """[n, 3] metres."""
    normals: Floats
    """[n, 3] unit."""
    logarithms: Floats
    """[n, 3] mean log radiance, RGB."""
    variances: Floats
    """[n] of the mean over the channels within the patch."""
    clipped: Floats
    """[n] share of the pixels that are clipped."""
    bright: SeenBright = field(default_factory=SeenBright)
    """Clipped surface, patches or not."""

    @property
    def count(self) -> int:
        """Number of patches."""
        return len(self.positions)


class PatchesInPicture:
    """What one picture shows of patches; begun when this is made."""

    def __init__(
        self,
        engine: Engine,
        camera: CameraModel,
        surface: Surface,
        radiance: cl_array.Array,
        volume: Volume,
        volume_from_camera: Floats,
    ) -> None:
        """radiance: [h, w] float4 as in Measurement, in the units of the first picture. volume_from_camera: [4, 4]."""
        step = max(2, camera.width // _BLOCKS_ACROSS)
        cols, rows = camera.width // step, camera.height // step
        seen = engine.array_to_read((6, rows, cols), cl_types.float4)
        engine.launch(
            engine.kernel("patches.cl", "gather_patches"),
            (cols, rows),
            cols,
            rows,
            step,
            camera.width,
            _TOLERANCE_VOXELS * volume.voxel_m,
            float4(*volume_from_camera[:3, 3], 0.0),
            float4(*volume_from_camera[:3, 2], 0.0),
            1.0 / (camera.fx * camera.fy),
            surface.positions,
            surface.normals,
            surface.labels,
            radiance,
            seen,
        )
        self._seen = engine.begin_download(seen)
        self._origin_world = volume.origin_world.copy()
        self._eye = volume_from_camera[:3, 3] + self._origin_world

    def seen(self) -> Seen:
        """The patches."""
        planes = self._seen.result().view(np.float32).reshape(6, -1, 4).astype(np.float64)
        at, towards, show, bright_at, bright_towards, bright_show = planes
        used = at[:, 3] >= LEAST_SHARE
        positions = at[used, :3] + self._origin_world
        is_bright = bright_at[:, 3] > 0
        bright = SeenBright(
            bright_at[is_bright, :3] + self._origin_world,
            bright_towards[is_bright, :3],
            bright_show[is_bright, :3],
            bright_at[is_bright, 3],
            self._eye,
        )
        return Seen(positions, towards[used, :3], show[used, :3], show[used, 3], towards[used, 3], bright)
