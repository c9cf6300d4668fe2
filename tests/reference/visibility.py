"""Float64 twins: a ray's exact walk through solid voxels (include/visibility.clh), and find_blockers (blockers.clh)."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]


def walk(
    solid: NDArray[np.bool_], voxel_m: float, origins: Floats, directions: Floats, longest_m: float = np.inf
) -> tuple[Floats, NDArray[np.int64]]:
    """Along unit rays to the first cube of `solid` [z, y, x] that is entered before `longest_m`: [n] metres, inf where
    there is none, and [n, 3] the cube (z, y, x), -1 where there is none (Amanatides & Woo 1987).

    Columns are arrays of their own: along rows of 3 NumPy is slow.
    """
    position, size = (origins / voxel_m).T, np.array(solid.shape[::-1])[:, None]
    slope = np.where(np.abs(directions) < 1e-12, 1e-12, directions).T
    cell = np.floor(position).astype(int)
    step = np.sign(slope).astype(int)
    onward = (cell + (step > 0) - position) / slope
    period = np.abs(1 / slope)
    number = np.arange(len(origins))  # of the rays that still go on
    entered = np.zeros(len(origins))
    found, voxels = np.full(len(origins), np.inf), np.full((len(origins), 3), -1)
    while len(number):
        inside = ((cell >= 0) & (cell < size)).all(0)
        x, y, z = np.clip(cell, 0, size - 1)
        met = inside & solid[z, y, x]
        found[number[met]], voxels[number[met]] = entered[met], cell[::-1, met].T
        gone = ((cell < 0) & (step < 0) | (cell >= size) & (step > 0)).any(0)
        on = ~met & ~gone & (onward.min(0) * voxel_m < longest_m)
        if not on.all():
            number, cell, step, onward, period = (a[..., on] for a in (number, cell, step, onward, period))
        axis, columns = onward.argmin(0), np.arange(len(number))
        entered = onward[axis, columns]
        cell[axis, columns] += step[axis, columns]
        onward[axis, columns] += period[axis, columns]
    return found * voxel_m, voxels


def first_solid(solid: NDArray[np.bool_], voxel_m: float, origins: Floats, directions: Floats) -> Floats:
    """[n] metres along unit rays to the first cube of `solid` [z, y, x], inf: none."""
    return walk(solid, voxel_m, origins, directions)[0]


def trace_volume(
    solid: NDArray[np.bool_], voxel_m: float, origins: Floats, directions: Floats, ray_length_m: float
) -> NDArray[np.bool_]:
    """[n] whether unit rays are free of the cubes of `solid` [z, y, x] for `ray_length_m`."""
    return walk(solid, voxel_m, origins, directions, ray_length_m)[0] >= ray_length_m


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
