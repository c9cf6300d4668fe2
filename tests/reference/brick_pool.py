"""Twins of cl_kernels/brick_pool.cl, on pools [slots, 512, 2] of tsdf and weight and [slots, 512] of colours."""

from __future__ import annotations

from typing import Any

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


def copy_bricks(source: NDArray[Any], chosen: NDArray[Any], target: NDArray[Any], places: NDArray[Any]) -> NDArray[Any]:
    """`target` with rows `chosen` of `source` at `places`."""
    result = target.copy()
    result[places] = source[chosen]
    return result
