"""Float64 twin of cl_kernels/merge.cl: the hybrid geometry buffer (thesis 4.2.2, first two cases of eq. 4.3).

Where the sensor measures nothing the volume's surface is kept (the third case without its vote of the neighbours), and
where the volume has none either there is none.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from protocol.frames import CameraModel

NONE, STATIC, DYNAMIC = 0, 1, 2
REACH_PX = 2
Floats = NDArray[np.float64]


def agreement_m(depth_m: Floats, voxel_m: float) -> Floats:
    """lambda_D: 1.5 voxels and four deviations of the sensor's axial noise (Nguyen et al. 2012, eq. 3), metres."""
    return 1.5 * voxel_m + 4 * (0.0012 + 0.0019 * (depth_m - 0.4) ** 2)


def unproject(camera: CameraModel, depth_m: Floats) -> Floats:
    """[h, w, 3] measured points in camera space."""
    v, u = np.mgrid[: camera.height, : camera.width]
    return depth_m[..., None] * np.stack(
        [(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, np.ones_like(u)], -1
    )


def neighbour(camera: CameraModel, points: Floats, dx: int, dy: int) -> Floats:
    """[h, w, 3] the point `dx`, `dy` pixels on where it is on the same surface, else the pixel's own.

    The same surface: depths less apart than 2 % and 5 mm, or than REACH_PX pixels of a surface seen at a slope of 3.
    """
    height, width = points.shape[:2]
    v, u = np.mgrid[:height, :width]
    inside = (u + dx >= 0) & (u + dx < width) & (v + dy >= 0) & (v + dy < height)
    other = points[np.clip(v + dy, 0, height - 1), np.clip(u + dx, 0, width - 1)]
    depth, there = points[..., 2], other[..., 2]
    edge = max(0.02, 3 * REACH_PX / camera.fx) * depth + 0.005
    same = inside & (there > 0) & (np.abs(there - depth) < edge)
    return np.where(same[..., None], other, points)


def measured_normals(camera: CameraModel, depth_m: Floats) -> Floats:
    """[h, w, 3] unit normals in camera space, to the camera, by differences two pixels to either side; 0 if none."""
    points = unproject(camera, depth_m)
    along_x = neighbour(camera, points, REACH_PX, 0) - neighbour(camera, points, -REACH_PX, 0)
    along_y = neighbour(camera, points, 0, REACH_PX) - neighbour(camera, points, 0, -REACH_PX)
    normals = np.cross(along_y, along_x)
    length = np.linalg.norm(normals, axis=-1, keepdims=True)
    return np.where(length > 1e-12, normals / np.where(length > 0, length, 1), 0)


def merge_depth(
    camera: CameraModel,
    volume_from_camera: Floats,
    depth_m: Floats,
    voxel_m: float,
    positions: Floats,
    normals: Floats,
) -> tuple[Floats, Floats, NDArray[np.int64]]:
    """positions, normals [h, w, 4] (w = 1 where valid) and labels [h, w] of the merged buffer.

    positions, normals: the volume's surface; depth_m: measured, 0 = none.
    """
    rotation, origin = volume_from_camera[:3, :3], volume_from_camera[:3, 3]
    predicted = (positions[..., :3] - origin) @ rotation[:, 2]
    has_surface, has_depth = positions[..., 3] > 0, depth_m > 0
    agrees = np.abs(depth_m - predicted) < agreement_m(depth_m, voxel_m)
    static = has_surface & (~has_depth | agrees)
    dynamic = ~static & has_depth
    facing = measured_normals(camera, depth_m)
    points = unproject(camera, depth_m) @ rotation.T + origin
    ones = np.ones(depth_m.shape)[..., None]
    sensed = np.concatenate([points, ones], -1), np.concatenate([facing @ rotation.T, facing.any(-1)[..., None]], -1)
    merged = [np.where(dynamic[..., None], new, old) for new, old in zip(sensed, (positions, normals), strict=True)]
    return merged[0], merged[1], np.where(static, STATIC, np.where(dynamic, DYNAMIC, NONE))
