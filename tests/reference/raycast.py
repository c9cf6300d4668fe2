"""Float64 twin of cl_kernels/raycast.cl: definition of the predicted surface (Newcombe et al. 2011, 3.3; thesis 4.2.1).

The surface is where the trilinear field first falls through zero along a ray. It is looked for in tiny fixed steps and
narrowed down by bisection: no bricks, no solid cells, no jumps.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from protocol.frames import CameraModel

STEP_VOXELS = 0.2
Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]


def trilinear(tsdf: Floats, weight: Floats, points: Floats) -> tuple[Floats, Bools]:
    """tsdf at points [..., 3] in voxels (voxel i has its centre at i + 0.5), and whether all eight voxels were seen.

    What lies outside the volume was not seen. tsdf, weight: [z, y, x].
    """
    base = np.floor(points - 0.5).astype(int)
    fraction = points - 0.5 - base
    size = np.array(tsdf.shape[::-1])
    value, seen = np.zeros(points.shape[:-1]), np.ones(points.shape[:-1], bool)
    for corner in np.ndindex(2, 2, 2):
        voxel = base + corner
        inside = ((voxel >= 0) & (voxel < size)).all(-1)
        x, y, z = np.clip(voxel, 0, size - 1).transpose(-1, *range(points.ndim - 1))
        share = np.where(np.array(corner) == 1, fraction, 1 - fraction).prod(-1)
        value += share * np.where(inside, tsdf[z, y, x], 1)
        seen &= inside & (weight[z, y, x] > 0)
    return value, seen


def gradient(tsdf: Floats, weight: Floats, points: Floats) -> Floats:
    """[..., 3] central differences one voxel to either side; of the trilinear cell itself where one is unseen."""
    axes = np.eye(3)
    ahead, behind = ([trilinear(tsdf, weight, points + sign * axis) for axis in axes] for sign in (1, -1))
    wide = np.stack([a[0] - b[0] for a, b in zip(ahead, behind, strict=True)], -1)
    seen = np.all([side[1] for side in (*ahead, *behind)], axis=0)
    inner = []
    for axis in axes:  # exact inside a cell, where the field is linear along each axis
        low = np.where(axis > 0, np.floor(points - 0.5) + 0.5, points)
        inner.append(trilinear(tsdf, weight, low + axis)[0] - trilinear(tsdf, weight, low)[0])
    return np.where(seen[..., None], wide, np.stack(inner, -1))


def raycast(
    camera: CameraModel,
    volume_from_camera: Floats,
    voxel_m: float,
    greatest_depth_m: float,
    tsdf: Floats,
    weight: Floats,
) -> tuple[Bools, Floats, Floats]:
    """Hits [h, w], positions [h, w, 3] (volume space, metres) and normals [h, w, 3] towards free space."""
    v, u = np.mgrid[: camera.height, : camera.width]
    rays = np.stack([(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, np.ones_like(u, float)], -1)
    length = np.linalg.norm(rays, axis=-1)
    directions = (rays / length[..., None]) @ volume_from_camera[:3, :3].T
    origin = volume_from_camera[:3, 3] / voxel_m
    farthest = np.linalg.norm(np.maximum(np.abs(origin), np.abs(np.array(tsdf.shape[::-1]) - origin)))
    hit, at = np.zeros(length.shape, bool), np.zeros(length.shape)
    before, was_seen = trilinear(tsdf, weight, np.broadcast_to(origin, directions.shape))
    for step in range(1, int(farthest / STEP_VOXELS) + 1):
        t = step * STEP_VOXELS
        value, seen = trilinear(tsdf, weight, origin + t * directions)
        falls = ~hit & was_seen & seen & (before >= 0) & (value < 0) & (t * voxel_m < greatest_depth_m * length)
        hit, at = hit | falls, np.where(falls, t, at)
        before, was_seen = value, seen
    low, high = at - STEP_VOXELS, at.copy()
    for _ in range(30):
        middle = (low + high) / 2
        in_front = trilinear(tsdf, weight, origin + middle[..., None] * directions)[0] >= 0
        low, high = np.where(in_front, middle, low), np.where(in_front, high, middle)
    points = origin + high[..., None] * directions
    normals = gradient(tsdf, weight, points)
    steepness = np.linalg.norm(normals, axis=-1)
    hit &= (steepness > 0) & ((normals * directions).sum(-1) < 0)
    normals = normals / np.where(steepness > 0, steepness, 1)[..., None]
    return hit, np.where(hit[..., None], points * voxel_m, 0), np.where(hit[..., None], normals, 0)
