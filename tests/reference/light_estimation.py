"""Float64 twin of cl_kernels/light_estimation.cl."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
STATIC = 1
TILE = 8
POOL_BEFORE, POOL_AFTER = 1, 2
"""A pool reaches from so many samples before its own to so many after."""


def gather_samples(
    stride: int,
    radiance: Floats,
    labels: NDArray[np.uint8],
    openness: Floats,
    flatness: Floats,
    least_openness: float,
    least_flatness: float,
) -> Floats:
    """Observed [rows, cols, 4]: mean colour of the 3 x 3 pixels around each sample, weight 1; all 0 if it is unusable.

    radiance [h, w, 4], labels [h, w], openness and flatness [rows, cols].
    """
    height, width = labels.shape
    rows, cols = openness.shape
    observed = np.zeros((rows, cols, 4))
    for row in range(rows):
        for col in range(cols):
            y, x = stride // 2 + row * stride, stride // 2 + col * stride
            window = np.ix_(np.clip([y - 1, y, y + 1], 0, height - 1), np.clip([x - 1, x, x + 1], 0, width - 1))
            usable = (radiance[window][..., 3] > 0).all() and (labels[window] == STATIC).all()
            if usable and openness[row, col] >= least_openness and flatness[row, col] >= least_flatness:
                observed[row, col, :3] = radiance[window][..., :3].mean((0, 1))
                observed[row, col, 3] = 1
    return observed


def pool_samples(
    positions: Floats, normals: Floats, transfer: Floats, observed: Floats, voxel_m: float
) -> tuple[Floats, Floats]:
    """Means of transfer [rows, cols, n] and observed [rows, cols, 4] over the pool of samples on one surface around
    every second sample: [ceil(rows / 2), ceil(cols / 2), ...].

    positions, normals [rows, cols, 3] at the samples. The weight of a mean is the share of samples in it.
    """
    rows, cols, n = transfer.shape
    pooled_transfer = np.zeros((-(-rows // 2), -(-cols // 2), n))
    pooled = np.zeros((*pooled_transfer.shape[:2], 4))
    for row in range(0, rows, 2):
        for col in range(0, cols, 2):
            if observed[row, col, 3] <= 0:
                continue
            members = []
            for r in range(max(row - POOL_BEFORE, 0), min(row + POOL_AFTER + 1, rows)):
                for c in range(max(col - POOL_BEFORE, 0), min(col + POOL_AFTER + 1, cols)):
                    offset = positions[r, c] - positions[row, col]
                    near = abs(offset @ normals[row, col]) < voxel_m + 0.1 * np.linalg.norm(offset)
                    if observed[r, c, 3] > 0 and near and normals[r, c] @ normals[row, col] > 0.9:
                        members.append((r, c))
            if members:
                index = tuple(np.array(members).T)
                pooled_transfer[row // 2, col // 2] = transfer[index].mean(0)
                pooled[row // 2, col // 2] = [
                    *observed[index][:, :3].mean(0),
                    len(members) / (POOL_BEFORE + POOL_AFTER + 1) ** 2,
                ]
    return pooled_transfer, pooled


def accumulate_tiles(transfer: Floats, observed: Floats) -> Floats:
    """[tiles, entries + 2] packed sums over tiles of 8 x 8 samples: upper triangle of sum w s^T s for s = (T, r, g, b),
    sum of w, number of samples with w > 0. transfer [rows, cols, n], observed [rows, cols, 4] (rgb, w).
    """
    rows, cols, n = transfer.shape
    upper = np.triu_indices(n + 3)
    sums = []
    for row in range(0, rows, TILE):
        for col in range(0, cols, TILE):
            tile = np.s_[row : row + TILE, col : col + TILE]
            weight = observed[tile][..., 3].ravel()
            samples = np.concatenate([transfer[tile], observed[tile][..., :3]], -1).reshape(-1, n + 3)
            total = samples.T @ (weight[:, None] * samples)
            sums.append([*total[upper], weight.sum(), (weight > 0).sum()])
    return np.array(sums)
