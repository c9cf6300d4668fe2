"""Float64 twins of cl_kernels/volume.cl: bricks near a measured surface, solid cells, gaps between solid bricks."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from protocol.frames import CameraModel
from tests.reference.integrate import signed_distance, voxel_centers

BRICK = 8
CELL = 2
Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]


def by_bricks(dense: Bools, side: int = BRICK) -> Bools:
    """[z, y, x] whether any voxel of each cube of `side` voxels is set."""
    z, y, x = (size // side for size in dense.shape)
    return dense.reshape(z, side, y, side, x, side).any(axis=(1, 3, 5))


def mark_bricks(
    camera: CameraModel,
    volume_from_camera: Floats,
    depth_m: Floats,
    bricks: tuple[int, int, int],
    voxel_m: float,
    ray_length_m: float,
) -> Bools:
    """[z, y, x] bricks with a voxel within `ray_length_m`, along its ray, of the surface measured at its pixel."""
    centers = voxel_centers(tuple(BRICK * count for count in reversed(bricks)), voxel_m)
    points = (centers - volume_from_camera[:3, 3]) @ volume_from_camera[:3, :3]
    return by_bricks(np.abs(signed_distance(camera, points, depth_m, ray_length_m)) <= ray_length_m)


def find_solid(tsdf: Floats, weight: Floats) -> tuple[NDArray[np.uint64], NDArray[np.uint8]]:
    """Masks of cells [z, y, x] and of their voxels [z, y, x, 64 cells], x fastest, from tsdf and weight [z, y, x]."""
    solid = (weight > 0) & (tsdf < 0)
    z, y, x = (size // BRICK for size in solid.shape)
    cells = solid.reshape(z, 4, 2, y, 4, 2, x, 4, 2).transpose(0, 3, 6, 1, 4, 7, 2, 5, 8).reshape(z, y, x, 64, 8)
    octets = (cells * (1 << np.arange(8))).sum(-1).astype(np.uint8)
    masks = ((octets != 0) * (np.uint64(1) << np.arange(64, dtype=np.uint64))).sum(-1)
    return masks.astype(np.uint64), octets


def near_solid(solid: NDArray[np.uint64]) -> Bools:
    """[z, y, x] whether a brick, or the two cells around it, contain a solid cell."""
    z, y, x = solid.shape
    cells = (solid[..., None] >> np.arange(64, dtype=np.uint64)) & np.uint64(1)
    dense = cells.astype(bool).reshape(z, y, x, 4, 4, 4).transpose(0, 3, 1, 4, 2, 5).reshape(4 * z, 4 * y, 4 * x)
    windows = np.lib.stride_tricks.sliding_window_view(np.pad(dense, 2), (8, 8, 8))
    return windows[::4, ::4, ::4].any((3, 4, 5))


def start_gaps(solid: NDArray[np.uint64], limit: int) -> NDArray[np.uint8]:
    """0 where a brick has a solid voxel, else `limit`."""
    return np.where(solid != 0, 0, limit).astype(np.uint8)


def changed_box(before: NDArray[Any], now: Bools) -> NDArray[np.int64]:
    """[2, 3] corners (x, y, z) of the box around the bricks [z, y, x] that differ; (2^30, -2^30) where none does."""
    places = np.argwhere(before != now)[:, ::-1]
    none = np.full((2, 3), [[1 << 30], [-(1 << 30)]])
    return np.stack([places.min(0), places.max(0)]) if len(places) else none


def gap_along_axis(inner: NDArray[np.uint8], axis: int, limit: int) -> NDArray[np.uint8]:
    """[2 variants, z, y, x] from [variants, z, y, x]: the least over bricks `offset` ahead of max(offset, theirs)."""
    values = np.moveaxis(inner, 3 - axis, -1).astype(int)
    size = values.shape[-1]
    results = []
    for ahead in (-1, 1):
        nearest = np.full(values.shape, limit)
        for here in range(size):
            for offset in range(min(limit, here + 1 if ahead < 0 else size - here)):
                there = np.maximum(values[..., here + ahead * offset], offset)
                nearest[..., here] = np.minimum(nearest[..., here], there)
        results.append(np.moveaxis(nearest, -1, 3 - axis))
    return np.concatenate(results).astype(np.uint8)


def octant_gaps(occupied: Bools, limit: int) -> NDArray[np.uint8]:
    """[octant, z, y, x] Chebyshev distance to the nearest occupied brick in each octant, by looking at all of them.

    Octant bits 0, 1, 2: towards higher x, y, z; a brick's own planes belong to all octants. At most `limit`.
    """
    places = np.argwhere(occupied)
    bricks = np.argwhere(np.ones_like(occupied))
    offsets = places[None] - bricks[:, None]
    gaps = np.full((8, len(bricks)), limit)
    for octant in range(8):
        signs = np.array([1 if octant & bit else -1 for bit in (4, 2, 1)])
        ahead = offsets * signs
        distance = np.where((ahead >= 0).all(-1), ahead.max(-1), limit)
        gaps[octant] = np.minimum(distance.min(axis=1, initial=limit), limit)
    return gaps.reshape(8, *occupied.shape).astype(np.uint8)
