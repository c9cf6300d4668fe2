"""Float64 twin of cl_kernels/radiance_transfer.cl."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from tests.reference.sh import open_transfer

Floats = NDArray[np.float64]
IsFree = Callable[[Floats, Floats], NDArray[np.bool_]]


def transfer_radiance(
    positions: Floats, normals: Floats, stride: int, directions: Floats, basis: Floats, offset_m: float, is_free: IsFree
) -> tuple[Floats, Floats, NDArray[np.bool_]]:
    """T(x) = 1/pi integral of V max(n.w, 0) Y(w) dw (thesis eq. 5.2), the open part exact, the blocked part summed.

    positions, normals [h, w, 4]; directions [sets, count, 4]; basis [sets, count, n]; is_free(origins, directions).
    -> transfer [rows, cols, n], openness [rows, cols] (-1: no surface), free [rows, cols, count].
    """
    n = basis.shape[-1]
    half = stride // 2
    rows, cols = positions.shape[0] // stride, positions.shape[1] // stride
    count = directions.shape[1]
    transfer, openness = np.zeros((rows, cols, n)), np.full((rows, cols), -1.0)
    free = np.zeros((rows, cols, count), bool)
    for row in range(rows):
        for col in range(cols):
            position, normal = (a[half + row * stride, half + col * stride] for a in (positions, normals))
            if position[3] <= 0 or normal[3] <= 0:
                continue
            arriving = directions[(row % 2) * 2 + col % 2]
            cosine = arriving[:, :3] @ normal[:3]
            share = np.maximum(cosine, 0) * arriving[:, 3] / np.pi
            origins = np.tile(position[:3] + offset_m * normal[:3], (count, 1))
            blocked = ~is_free(origins, arriving[:, :3])
            transfer[row, col] = open_transfer(normal[:3], round(n**0.5))
            transfer[row, col] -= (share * blocked) @ basis[(row % 2) * 2 + col % 2]
            openness[row, col] = 1 - share[blocked].sum() / share.sum()
            free[row, col] = (cosine > 0) & ~blocked
    return transfer, openness, free
