"""Float64 twin of change_mask.cl: the cells of a picture in which a ratio counts."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from tests.reference.composite import Buffer, Floats, Samples, cells_of

PLACES = (0.0, 0.5, 1.0)
"""Of a cell, between which a box's weights change linearly."""


def change_of(ratio: Floats) -> Floats:
    """[rows, cols] how far the valid ones of `ratio` [rows, cols, 4] are from 1."""
    return np.where(ratio[..., 3] > 0, np.abs(ratio[..., :3] - 1).max(-1), 0.0)


def greatest_mean(change: Floats, valid: NDArray[np.bool_], row: int, col: int) -> float:
    """Of `change` over boxes four samples wide around places in the cell that begins at sample (row, col)."""
    means = [0.0]
    for v in PLACES:
        for u in PLACES:
            down, across = (
                np.clip(2.5 - np.abs(np.arange(n) - at), 0, 1)
                for n, at in zip(change.shape, (row + v, col + u), strict=True)
            )
            weights = np.outer(down, across) * valid
            means.append(float((weights * change).sum() / max(weights.sum(), 1e-6)))
    return max(means)


def least_weight(points: Floats, normals: Floats, tolerance_m: float) -> float:
    """No less than what any of `points` [n, 3] counts for another, as they lie about the plane of the first."""
    offsets = points - points[0]
    off_m, apart_m = np.abs(offsets @ normals[0]).max(), np.linalg.norm(offsets, axis=1).max()
    angle = np.arccos(np.clip((normals @ normals[0]).min(), -1, 1))
    facing = np.cos(2 * angle) if angle < np.pi / 4 else 0.0
    off = 2 * (off_m + 2 * np.sin(angle / 2) * apart_m) / tolerance_m
    return float(facing**4 / (1 + off**4))


def mark_changes(
    ratio: Samples,
    surface: Buffer,
    tolerance_m: float,
    spare: float,
    refined: NDArray[np.bool_] | None = None,
    bicubic: bool = False,
) -> NDArray[np.bool_]:
    """[rows + 1, cols + 1] as mark_reached says. refined: [h, w] pixels that have a ratio of their own."""
    (rows, cols), stride = ratio.values.shape[:2], ratio.stride
    height, width = surface.positions.shape[:2]
    change, valid = change_of(ratio.values), ratio.values[..., 3] > 0
    cell_of_x, cell_of_y = cells_of(width, stride), cells_of(height, stride)
    there = surface.positions[..., 3] > 0
    reached = np.zeros((rows + 1, cols + 1), bool)
    for row, col in np.ndindex(reached.shape):
        window = np.s_[max(row - 3, 0) : row + 3, max(col - 3, 0) : col + 3]
        most = change[window].max(initial=0.0)
        own = np.outer(cell_of_y == row - 1, cell_of_x == col - 1) & there
        if most > 0 and refined is not None and (own & refined).any():
            reached[row, col] = True
        elif most > spare:
            around = np.zeros_like(there)
            around[stride // 2 :: stride, stride // 2 :: stride][:rows, :cols][window] = valid[window]
            chosen = own | around
            first = np.argwhere(around[: (row + 3) * stride, : (col + 3) * stride])
            inner = [(y, x) for y, x in first if y < row * stride and x < col * stride]
            start = inner[-1] if inner else first[0]
            points = np.concatenate([surface.positions[tuple(start)][None, :3], surface.positions[chosen][:, :3]])
            normals = np.concatenate([surface.normals[tuple(start)][None, :3], surface.normals[chosen][:, :3]])
            weight = 0.0 if bicubic or spare == 0 else least_weight(points, normals, tolerance_m)
            reached[row, col] = greatest_mean(change, valid, row - 1, col - 1) > spare * weight
    return reached
