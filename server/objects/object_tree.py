"""Bounding volume hierarchy of virtual objects for rays (include/virtual_objects.clh)."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

FEW_OBJECTS = 8
"""Up to this number, rays test every object, as in virtual_objects.clh."""
_NOWHERE = 1e30
"""Low corner of an empty box, above its high corner."""

Floats = NDArray[np.float64]


def grid_boxes(grid_from_volume: Floats, dims: NDArray[np.int32]) -> tuple[Floats, Floats]:
    """Low and high corners [n, 3] of boxes around grids of `dims` [n, 3] cells; volume metres and axes."""
    volume_from_grid = np.linalg.inv(grid_from_volume)
    half = dims[:, :, None] / 2
    center = (volume_from_grid[:, :3, :3] @ half)[..., 0] + volume_from_grid[:, :3, 3]
    reach = (np.abs(volume_from_grid[:, :3, :3]) @ half)[..., 0]
    rounding = 1e-6 * (np.abs(center) + reach)
    return center - reach - rounding, center + reach + rounding


def tree_rows(low: Floats, high: Floats) -> Floats:
    """[m, 16] the nodes of a tree around boxes [n, 3] (n > 0), depth first; the columns of virtual_objects.clh.

    A full binary tree, its leaves in Morton order of their centres; unused leaves are empty boxes.
    """
    count = len(low)
    height = (count - 1).bit_length()
    lows, highs = np.full((1 << height, 3), _NOWHERE), np.full((1 << height, 3), -_NOWHERE)
    order = np.argsort(_morton((low + high) / 2), kind="stable")
    lows[:count], highs[:count] = low[order], high[order]
    rows = np.zeros((2 * len(lows) - 1, 16))
    for level in range(height, -1, -1):
        under = (2 << (height - level)) - 1  # nodes of the subtree of a node of this level
        at = _depth_first(level, height)
        rows[at, :3], rows[at, 3:6], rows[at, 6], rows[at, 7] = lows, highs, at + under, -1
        if level == height:
            rows[at[:count], 7] = order
        if level > 0:
            lows, highs = np.minimum(lows[::2], lows[1::2]), np.maximum(highs[::2], highs[1::2])
    return rows


def _depth_first(level: int, height: int) -> NDArray[np.int64]:
    """Depth-first indices of a level's nodes, left to right: a step to the right child skips the left subtree."""
    place = np.arange(1 << level)
    number = np.full(len(place), level, np.int64)
    for bit in range(level):
        number += (place >> bit & 1) * ((1 << (height - level + bit + 1)) - 1)
    return number


def _morton(points: Floats) -> NDArray[np.int64]:
    """[n] Morton codes: 10 bits each of x, y and z, interleaved."""
    extent = np.ptp(points, axis=0)
    cells = ((points - points.min(axis=0)) / np.where(extent > 0, extent, 1) * 1023).astype(np.int64)
    bits = (cells[:, :, None] >> np.arange(10)) & 1
    codes: NDArray[np.int64] = (bits << (3 * np.arange(10) + np.arange(3)[:, None])).sum(axis=(1, 2))
    return codes
