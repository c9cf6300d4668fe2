"""Float64 twins: a ray's exact walk through solid voxels (include/visibility.clh), and find_blockers (blockers.clh)."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]


def first_solid(solid: NDArray[np.bool_], voxel_m: float, origins: Floats, directions: Floats) -> Floats:
    """[n] metres along unit rays to the first cube of `solid` [z, y, x], inf: none (Amanatides & Woo 1987)."""
    position, size = origins / voxel_m, np.array(solid.shape[::-1])
    slope = np.where(np.abs(directions) < 1e-12, 1e-12, directions)
    cell = np.floor(position).astype(int)
    step = np.sign(slope).astype(int)
    onward = (cell + (step > 0) - position) / slope
    period = np.abs(1 / slope)
    number = np.arange(len(origins))  # of the rays that still go on
    entered = np.zeros(len(origins))
    found = np.full(len(origins), np.inf)
    while len(number):
        inside = ((cell >= 0) & (cell < size)).all(-1)
        held = np.clip(cell, 0, size - 1)
        met = inside & solid[held[:, 2], held[:, 1], held[:, 0]]
        found[number[met]] = entered[met]
        gone = ((cell < 0) & (step < 0) | (cell >= size) & (step > 0)).any(-1)
        on = ~met & ~gone
        if not on.all():
            number, cell, step, onward, period = (a[on] for a in (number, cell, step, onward, period))
        rows, axis = np.arange(len(number)), onward.argmin(-1)
        entered = onward[rows, axis]
        cell[rows, axis] += step[rows, axis]
        onward[rows, axis] += period[rows, axis]
    return found * voxel_m


def trace_volume(
    solid: NDArray[np.bool_], voxel_m: float, origins: Floats, directions: Floats, ray_length_m: float
) -> NDArray[np.bool_]:
    """[n] whether unit rays are free of the cubes of `solid` [z, y, x] for `ray_length_m`."""
    return first_solid(solid, voxel_m, origins, directions) >= ray_length_m


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
