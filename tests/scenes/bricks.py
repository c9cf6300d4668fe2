"""Bricks of a TSDF that is known in closed form, on the host."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from server.volume.volume import BRICK, TRUNCATION_VOXELS, Bricks

Field = Callable[[NDArray[np.float64]], NDArray[Any]]
"""Points [..., 3] (x, y, z) in voxel units to one value, or one colour, each."""


def ball(center: tuple[float, float, float], radius: float) -> Field:
    """Signed distance in voxels, negative inside."""
    return lambda points: np.linalg.norm(points - np.array(center), axis=-1) - radius


def bricks_of(
    distance: Field,
    counts: tuple[int, int, int],
    seen: Field = lambda points: np.ones(points.shape[:-1]),
    color: Field = lambda points: np.full(points.shape, 0.25),
    colored: Field = lambda points: np.ones(points.shape[:-1]),
) -> Bricks:
    """The bricks of a grid of `counts` (x, y, z) in which `distance` (voxels) is below the truncation somewhere."""
    nx, ny, nz = counts
    z, y, x = np.mgrid[: BRICK * nz, : BRICK * ny, : BRICK * nx] + 0.5
    points = np.stack([x, y, z], axis=-1)
    bz, by, bx = np.mgrid[:nz, :ny, :nx].reshape(3, -1)
    tsdf = _cut(np.clip(distance(points) / TRUNCATION_VOXELS, -1, 1).astype(np.float32), counts)
    near = np.abs(tsdf).min(axis=(1, 2, 3)) < 1
    return Bricks(
        indices=np.stack([bx, by, bz], axis=-1).astype(np.int32)[near],
        tsdf=tsdf[near],
        weight=_cut(seen(points).astype(np.float32), counts)[near],
        colors=_cut(color(points).astype(np.float32), counts)[near],
        color_weight=_cut(colored(points).astype(np.uint8), counts)[near],
    )


def reordered(bricks: Bricks, order: NDArray[np.intp]) -> Bricks:
    """The same bricks in another order."""
    return Bricks(
        bricks.indices[order],
        bricks.tsdf[order],
        bricks.weight[order],
        bricks.colors[order],
        bricks.color_weight[order],
    )


def _cut(dense: NDArray[Any], counts: tuple[int, int, int]) -> NDArray[Any]:
    """[bricks, 8, 8, 8, ...] of an array [z, y, x, ...], bricks with x running fastest."""
    nx, ny, nz = counts
    split = dense.reshape(nz, BRICK, ny, BRICK, nx, BRICK, *dense.shape[3:])
    return np.moveaxis(split, (2, 4), (1, 2)).reshape(nx * ny * nz, BRICK, BRICK, BRICK, *dense.shape[3:])
