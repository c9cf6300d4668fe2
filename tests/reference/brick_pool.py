"""Twins of cl_kernels/brick_pool.cl, on pools [slots, 512, 2] of tsdf and weight and [slots, 512] of colours."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray


def place_bricks(
    bricks: NDArray[Any], slots: NDArray[Any], table: NDArray[Any], solid: NDArray[Any]
) -> tuple[NDArray[Any], NDArray[Any]]:
    """Table and solid masks [bricks] after bricks got new slots; without a slot (-1) a brick is not solid."""
    table, solid = table.copy(), solid.copy()
    table[bricks] = slots
    solid[bricks[slots == -1]] = 0
    return table, solid


def clear_slots(slots: NDArray[Any], voxels: NDArray[Any], colors: NDArray[Any]) -> tuple[NDArray[Any], NDArray[Any]]:
    """Voxels and colours after the bricks in `slots` were cleared."""
    voxels, colors = voxels.copy(), colors.copy()
    voxels[slots], colors[slots] = 0, 0
    return voxels, colors


def forget_colors(colors: NDArray[Any], share: float) -> NDArray[Any]:
    """Packed colours after their means have lost `share` of their weight, which is 1 less than the lowest six bits."""
    stored = (colors & 63).astype(np.int64)
    left = 1 + np.floor((1 - share) * (stored - 1) + 0.5).astype(np.int64)
    return np.asarray((colors.astype(np.int64) - stored + np.where(stored > 0, left, 0)).astype(np.uint32))


def copy_bricks(source: NDArray[Any], chosen: NDArray[Any], target: NDArray[Any], places: NDArray[Any]) -> NDArray[Any]:
    """`target` with rows `chosen` of `source` at `places`."""
    result = target.copy()
    result[places] = source[chosen]
    return result
