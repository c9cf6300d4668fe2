"""Float64 twin of cl_kernels/radiance_transfer.cl."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from tests.reference.sh import open_transfer

Floats = NDArray[np.float64]
IsFree = Callable[[Floats, Floats], NDArray[np.bool_]]


def direction_set(row: NDArray[np.int64] | int, col: NDArray[np.int64] | int) -> NDArray[np.int64] | int:
    """Which of the 64 direction sets a sample traces: 16 in a block of 4 x 4 samples, others in the next block."""
    return ((row // 4 % 2) * 2 + col // 4 % 2) * 16 + (row % 4) * 4 + col % 4


def smooth_normal(
    positions: Floats, normals: Floats, x: int, y: int, radius: int, voxel_m: float
) -> tuple[Floats, float]:
    """Mean unit normal of the window's pixels on the same smooth surface as (x, y), and their share of the window.

    positions, normals [h, w, 4]. The same: facing within 25 degrees, off the tangent plane by less than a voxel and
    0.3 of the distance.
    """
    window = np.s_[max(y - radius, 0) : y + radius + 1, max(x - radius, 0) : x + radius + 1]
    position, normal = positions[y, x, :3], normals[y, x, :3]
    offset = positions[window][..., :3] - position
    near = np.abs(offset @ normal) < voxel_m + 0.3 * np.linalg.norm(offset, axis=-1)
    valid = (positions[window][..., 3] > 0) & (normals[window][..., 3] > 0)
    same = valid & near & (normals[window][..., :3] @ normal > 0.9)
    total = normals[window][..., :3][same].sum(0)
    return total / np.linalg.norm(total), float(same.sum()) / (2 * radius + 1) ** 2


def transfer_radiance(
    positions: Floats,
    normals: Floats,
    stride: int,
    radius: int,
    directions: Floats,
    basis: Floats,
    voxel_m: float,
    is_free: IsFree,
) -> tuple[Floats, Floats, Floats, NDArray[np.bool_]]:
    """T(x) = 1/pi integral of V max(n.w, 0) Y(w) dw (thesis eq. 5.2), the open part exact, the blocked part summed.

    positions, normals [h, w, 4]; directions [sets, count, 4]; basis [sets, count, n]; is_free(origins, directions).
    -> transfer [rows, cols, n], openness (-1: no surface) and flatness [rows, cols], free [rows, cols, count].
    """
    n = basis.shape[-1]
    half = stride // 2
    rows, cols = positions.shape[0] // stride, positions.shape[1] // stride
    count = directions.shape[1]
    transfer, openness, flatness = np.zeros((rows, cols, n)), np.full((rows, cols), -1.0), np.zeros((rows, cols))
    free = np.zeros((rows, cols, count), bool)
    for row in range(rows):
        for col in range(cols):
            x, y = half + col * stride, half + row * stride
            if positions[y, x, 3] <= 0 or normals[y, x, 3] <= 0:
                continue
            normal, flatness[row, col] = smooth_normal(positions, normals, x, y, radius, voxel_m)
            turned = direction_set(row, col)
            arriving = directions[turned]
            cosine = arriving[:, :3] @ normal
            share = np.maximum(cosine, 0) * arriving[:, 3] / np.pi
            origins = np.tile(positions[y, x, :3] + voxel_m * normal, (count, 1))
            blocked = ~is_free(origins, arriving[:, :3])
            transfer[row, col] = open_transfer(normal, round(n**0.5)) - (share * blocked) @ basis[turned]
            openness[row, col] = 1 - share[blocked].sum() / share.sum()
            free[row, col] = (cosine > 0) & ~blocked
    return transfer, openness, flatness, free
