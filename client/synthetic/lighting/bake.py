"""Precomputed shadows of solids on each other, integrated over the sphere at every grid sample.

The tables contain the *occluded* part of the Lambert transfer; the transfer is the closed-form unshadowed part minus
this. So surfaces with an open hemisphere are exact, and only shadows have an error of quadrature.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from client.synthetic.lighting.harmonics import COEFFICIENTS, basis
from client.synthetic.solids.carved import CLEARANCE_M, Carved
from client.synthetic.solids.charts import Grid
from client.synthetic.solids.polyhedra import Points, Solid
from client.synthetic.solids.shell import Shell

RAYS_AT_ONCE = 65536
"""Points times directions of a tile; small enough for the processor's cache."""
BATCH = 64
"""Tiles whose sums over directions are one matrix product."""
LIFT_M = 1e-4
"""A sample buried by less than this counts as visible."""
FILL_PASSES = 2

Floats = NDArray[np.float32]


def bake(solids: list[Solid], atlas: list[list[Grid]], directions: Floats) -> Floats:
    """[total, 16] occluded Lambert transfer, including 1/pi, of all grid samples, world axes.

    `directions` [n, 3] float32, unit, of equal solid angle.
    """
    table = np.zeros((table_size(atlas), COEFFICIENTS), np.float32)
    for own, grids in enumerate(atlas):
        for part, grid in enumerate(grids):
            table[grid.offset : grid.offset + grid.size] = _bake_grid(solids, own, part, grid, directions)
    return table


def table_size(atlas: list[list[Grid]]) -> int:
    """Number of samples in all grids."""
    return atlas[-1][-1].offset + atlas[-1][-1].size


def blocked_directions(
    solids: Sequence[Solid],
    skip: Solid | None,
    points: Floats,
    directions: Floats,
    mask: NDArray[np.bool_] | None = None,
) -> NDArray[np.bool_]:
    """[points, directions] True where any solid except `skip` blocks a unit direction.

    Points should be close together, which limits the directions that a solid can block. Only directions in `mask`
    [directions] are tested, the others stay False.
    """
    blocked = np.zeros((len(points), len(directions)), bool)
    middle = points.mean(axis=0)
    radius_of_points = float(np.linalg.norm(points - middle, axis=1).max())
    still_open = np.ones(len(directions), bool) if mask is None else mask
    for solid in solids:
        if solid is skip:
            continue
        tested = np.flatnonzero(still_open & directions_near(solid, middle, directions, radius_of_points))
        if tested.size:
            blocked[:, tested] |= solid.blocks(points, directions[tested])
        if solid.bounds is None:
            still_open = still_open & ~blocked.all(axis=0)
    return blocked


def directions_near(solid: Solid, middle: Floats, directions: Floats, radius_of_points: float) -> NDArray[np.bool_]:
    """[directions] which may hit the solid from points within `radius_of_points` of `middle`."""
    everything = np.ones(len(directions), bool)
    if solid.bounds is None:
        return everything
    center, radius = solid.bounds
    offset = center - middle
    distance = float(np.linalg.norm(offset))
    if distance <= radius + radius_of_points:
        return everything
    cone = np.sqrt(1 - ((radius + radius_of_points) / distance) ** 2)
    near: NDArray[np.bool_] = directions @ (offset / distance).astype(np.float32) > cone - 1e-4
    return near


def seen_samples(solid: Solid, part: int, grid: Grid) -> tuple[Points, Points, Solid | None]:
    """Origins of shadow rays of a chart's grid, surface normals there, and a solid that these rays cannot hit."""
    positions, normals = grid.samples()
    if isinstance(solid, Carved):
        normals = -normals if solid.inwards(part) else normals
        return positions + CLEARANCE_M * normals, normals, None
    # A convex solid does not shadow itself.
    return positions, normals, None if isinstance(solid, Shell) else solid


def _bake_grid(solids: list[Solid], own: int, part: int, grid: Grid, directions: Floats) -> Floats:
    positions, normals, skip = seen_samples(solids[own], part, grid)
    buried = buried_samples(solids, own, part, grid)
    values = np.zeros((grid.rows, grid.columns, COEFFICIENTS), np.float32)
    weights = basis(directions) * np.float32(4 / len(directions))  # 4 pi / n of solid angle each, over pi
    if grid.is_flat:
        cosines = directions @ normals[0, 0].astype(np.float32)
        directions, weights = directions[cosines > 0], (cosines[:, None] * weights)[cosines > 0]
        solids = [solid for solid in solids if _rises_above(solid, positions[0, 0], normals[0, 0])]
    pieces = [piece for piece in tiles(grid, len(directions)) if not buried[piece].all()]
    for batch in (pieces[i : i + BATCH] for i in range(0, len(pieces), BATCH)):
        occlusion = _occlusion(
            solids, skip, grid, [positions[p] for p in batch], [normals[p] for p in batch], directions
        )
        sums = np.split(occlusion @ weights, np.cumsum([buried[p].size for p in batch])[:-1])
        for piece, of_piece in zip(batch, sums, strict=True):
            values[piece] = of_piece.reshape(*buried[piece].shape, COEFFICIENTS)
    fill_buried(values, buried, grid.chart.wraps)
    return values.reshape(-1, COEFFICIENTS)


def _rises_above(solid: Solid, point: Points, normal: Points) -> bool:
    """Whether part of the solid may be above the horizon of a flat face."""
    return solid.bounds is None or bool((solid.bounds[0] - point) @ normal > -solid.bounds[1])


def _occlusion(
    solids: list[Solid],
    skip: Solid | None,
    grid: Grid,
    positions: list[Points],
    normals: list[Points],
    directions: Floats,
) -> Floats:
    """[samples, directions] 1 where a direction is blocked, times the cosine on curved surfaces."""
    parts = []
    for places, ups in zip(positions, normals, strict=True):
        points = places.reshape(-1, 3).astype(np.float32)
        if grid.is_flat:
            parts.append(blocked_directions(solids, skip, points, directions).astype(np.float32))
        else:
            cosines = ups.reshape(-1, 3).astype(np.float32) @ directions.T
            facing: NDArray[np.bool_] = np.any(cosines > 0, axis=0)
            parts.append(blocked_directions(solids, skip, points, directions, facing) * np.maximum(cosines, 0))
    return np.concatenate(parts)


def tiles(grid: Grid, directions: int) -> list[tuple[slice, slice]]:
    """Tiles of a grid for this number of directions."""
    side = max(2, math.isqrt(RAYS_AT_ONCE // directions))
    starts = ((r, c) for r in range(0, grid.rows, side) for c in range(0, grid.columns, side))
    return [(slice(r, r + side), slice(c, c + side)) for r, c in starts]


def buried_samples(solids: list[Solid], own: int, part: int, grid: Grid) -> NDArray[np.bool_]:
    """[rows, columns] invisible samples: inside another solid or in an opening."""
    _, normals, _ = seen_samples(solids[own], part, grid)
    positions, _ = grid.samples()
    lifted = (positions + LIFT_M * normals).reshape(-1, 3)
    inside = np.zeros(len(lifted), bool)
    for number, solid in enumerate(solids):
        if number != own:
            inside |= solid.contains(lifted)
        elif isinstance(solid, Shell):
            inside |= solid.absent(positions.reshape(-1, 3))
        elif isinstance(solid, Carved):
            inside |= solid.absent(positions.reshape(-1, 3), part)
    return inside.reshape(positions.shape[:2])


def fill_buried(values: Floats, buried: NDArray[np.bool_], wraps: bool) -> None:
    """Set buried samples, in place, to the mean of their visible neighbours, as interpolation reads both."""
    unknown = buried.copy()
    for _ in range(FILL_PASSES):
        known = (~unknown).astype(values.dtype)[..., None]
        total, count = _around(values * known, wraps), _around(known, wraps)
        fresh = unknown & (count[..., 0] > 0)
        values[fresh] = total[fresh] / count[fresh]
        unknown &= ~fresh


def _around(values: Floats, wraps: bool) -> Floats:
    """Sum over the 3x3 neighbourhood."""
    padded = np.pad(values, ((0, 0), (1, 1), (0, 0)), mode="wrap" if wraps else "constant")
    padded = np.pad(padded, ((1, 1), (0, 0), (0, 0)))
    rows, columns = values.shape[:2]
    total = np.zeros_like(values)
    for row, column in np.ndindex(3, 3):
        total += padded[row : row + rows, column : column + columns]
    return total
