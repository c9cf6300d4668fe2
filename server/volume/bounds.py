"""Default bounds and voxel size of a volume."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from protocol.frames import CameraModel, RgbdFrame

_VOXELS_PER_SIDE = 256
_FINEST_VOXEL_M = 0.004
_TRUSTED_DEPTH_M = 5.0
_MARGIN_M = 0.15
_LEAST_SIDE_M = 0.5

Bounds = tuple[float, float, float, float, float, float]
"""Lowest corner, then highest, in world metres."""


def bounds_seen(camera: CameraModel, frame: RgbdFrame, world_from_camera: NDArray[np.float64]) -> Bounds:
    """World box around the surface that one frame measures within 5 m: the default volume.

    Raises ValueError for a frame without depth.
    """
    depth = frame.depth[::4, ::4] * camera.depth_scale_m
    v, u = np.nonzero((depth > 0) & (depth <= _TRUSTED_DEPTH_M) & (frame.depth[::4, ::4] != 65535))
    if len(u) < 16:
        raise ValueError("the first frame has no depth to place a volume around: point the camera at the scene")
    z = depth[v, u]
    lens, world_from_depth = camera.depth_lens, world_from_camera @ camera.color_from_depth
    points = np.stack([(4 * u - lens.cx) / lens.fx * z, (4 * v - lens.cy) / lens.fy * z, z], axis=1)
    points = points @ world_from_depth[:3, :3].T + world_from_depth[:3, 3]
    low, high = np.percentile(points, (1, 99), axis=0)
    center, half = (low + high) / 2, np.maximum((high - low) / 2 + _MARGIN_M, _LEAST_SIDE_M / 2)
    x0, y0, z0, x1, y1, z1 = (float(value) for value in (*(center - half), *(center + half)))
    return x0, y0, z0, x1, y1, z1


def default_voxel_m(bounds: Bounds) -> float:
    """Voxel side for `bounds`: the longest side over 256, 4 mm at least."""
    return max(_FINEST_VOXEL_M, max(bounds[axis + 3] - bounds[axis] for axis in range(3)) / _VOXELS_PER_SIDE)
