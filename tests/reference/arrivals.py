"""Float64 twin of cl_kernels/light/arrivals.cl."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from tests.reference.raycast import trilinear
from tests.reference.visibility import first_solid

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]


def trace_arrivals(
    points: Floats,
    normals: Floats | None,
    directions: Floats,
    tsdf: Floats,
    weight: Floats,
    colors: Floats,
    has_color: Bools,
    is_outdated: Bools,
    voxel_m: float,
    truncation_m: float,
) -> tuple[Floats, Floats]:
    """Arrivals [n, m, 4] as of the kernel, and how clearly each surface faces [n, m]: the cosine to its outward normal.

    points [n, 3], normals [n, 3] of the surface that they lie on, or None, directions [n, m, 3]; tsdf, weight,
    has_color and is_outdated (its colour is of another light) [z, y, x], colors [z, y, x, 3].
    """
    shape = directions.shape[:2]
    if normals is not None:
        points = _clear_of_surface(points, normals, tsdf, weight, voxel_m, truncation_m)
    origins, along = np.repeat(points, shape[1], axis=0), directions.reshape(-1, 3)
    solid = (weight > 0) & (tsdf < 0)
    distance = first_solid(solid, voxel_m, origins, along)
    met = np.isfinite(distance)
    if normals is not None:
        met &= np.einsum("nmk,nk->nm", directions, normals).ravel() > 0
    at = (origins + np.where(met, distance, 0.0)[:, None] * along) / voxel_m
    # The kernel's walk begins and goes on by 0.01 voxel, so it reads a voxel that it has entered.
    first, second = (_voxels(has_color.shape, at + step * along) for step in (0.01, -0.99))
    z, y, x = np.where(has_color[first], first, second)
    color, known, outdated = colors[z, y, x], has_color[z, y, x], is_outdated[z, y, x]
    slope, is_seen = _slope(tsdf, weight, at + 0.01 * along)
    facing = np.where(is_seen, (slope * along).sum(-1) / np.maximum(np.linalg.norm(slope, axis=-1), 1e-12), -1.0)
    result = np.zeros((len(origins), 4))
    is_front = met & known & (facing <= 0)
    result[is_front, :3] = color[is_front]
    result[:, 3] = np.where(met, np.where(is_front & ~outdated, 1.0, -1.0) * np.maximum(distance, 0.01 * voxel_m), 0.0)
    return result.reshape(*shape, 4), facing.reshape(shape)


def _clear_of_surface(
    points: Floats, normals: Floats, tsdf: Floats, weight: Floats, voxel_m: float, truncation_m: float
) -> Floats:
    """One voxel off the surface, by the normal and then by the field, where all of it is known."""
    origins = points + voxel_m * normals
    distance, is_seen = trilinear(tsdf, weight, origins / voxel_m)
    slope, _ = _slope(tsdf, weight, origins / voxel_m)
    steepness = np.linalg.norm(slope, axis=-1)
    missing = np.maximum(voxel_m - truncation_m * distance, 0.0)
    missing = np.where(is_seen & (steepness > 1e-6), missing, 0.0)
    return np.asarray(origins + (missing / np.maximum(steepness, 1e-12))[:, None] * slope)


def _voxels(shape: tuple[int, ...], at: Floats) -> tuple[NDArray[np.int64], ...]:
    """Indices z, y, x of the voxels that points [n, 3] (voxels) lie in."""
    x, y, z = np.clip(at.astype(np.int64), 0, np.array(shape[::-1]) - 1).T
    return z, y, x


def _slope(tsdf: Floats, weight: Floats, at: Floats) -> tuple[Floats, Bools]:
    """Gradient of the trilinear field at points [n, 3] (voxels), and whether all eight voxels around were seen."""
    parts = []
    for axis in np.eye(3):  # the field is linear along each axis within a cell
        low = np.where(axis > 0, np.floor(at - 0.5) + 0.5, at)
        high = np.where(axis > 0, low + 1 - 1e-9, at)
        parts.append(trilinear(tsdf, weight, high)[0] - trilinear(tsdf, weight, low)[0])
    return np.stack(parts, axis=-1), trilinear(tsdf, weight, at)[1]
