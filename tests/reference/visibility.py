"""Float64 twins: a ray's exact walk through solid voxels (include/visibility.clh), and find_blockers (blockers.clh)."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]


def trace_volume(
    solid: NDArray[np.bool_], voxel_m: float, origins: Floats, directions: Floats, reach_m: float
) -> NDArray[np.bool_]:
    """[n] whether unit rays are free of the cubes of `solid` [z, y, x] for `reach_m` (Amanatides & Woo 1987)."""
    position, size, most = origins / voxel_m, np.array(solid.shape[::-1]), reach_m / voxel_m
    slope = np.where(np.abs(directions) < 1e-12, 1e-12, directions)
    cell = np.floor(position).astype(int)
    step = np.sign(slope).astype(int)
    onward = (cell + (step > 0) - position) / slope
    period = np.abs(1 / slope)
    number = np.arange(len(origins))  # of the rays that still go on
    free = np.ones(len(origins), bool)
    while len(number):
        inside = ((cell >= 0) & (cell < size)).all(-1)
        held = np.clip(cell, 0, size - 1)
        met = inside & solid[held[:, 2], held[:, 1], held[:, 0]]
        free[number[met]] = False
        gone = ((cell < 0) & (step < 0) | (cell >= size) & (step > 0)).any(-1)
        on = ~met & ~gone & (onward.min(-1) < most)
        number, cell, step, onward, period = (a[on] for a in (number, cell, step, onward, period))
        rows, axis = np.arange(len(number)), onward.argmin(-1)
        cell[rows, axis] += step[rows, axis]
        onward[rows, axis] += period[rows, axis]
    return free


def find_blockers(
    solid: NDArray[np.bool_], origin: Floats, normal: Floats, reach: float, margin: float
) -> list[tuple[Floats, Floats]]:
    """Corners of the boxes, one a brick that comes within `reach`, around its voxels of `solid` [z, y, x] that rise
    above the plane through `origin`, or to `margin` below it; voxels.
    """
    cells = np.argwhere(solid)[:, ::-1]
    brick = cells // 8
    beside = np.maximum(np.maximum(8 * brick - origin, origin - 8 * brick - 8), 0)
    above = (cells + (normal > 0) - origin) @ normal > -margin
    chosen = above & ((beside**2).sum(1) <= reach**2)
    cells, brick = cells[chosen], brick[chosen]
    boxes = []
    for place in np.unique(brick, axis=0):
        own = cells[(brick == place).all(1)]
        boxes.append((own.min(0).astype(np.float64), own.max(0) + 1.0))
    return boxes
