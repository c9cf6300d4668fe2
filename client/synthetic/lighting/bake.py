"""Shadows of solids on each other, integrated once over the sphere of directions and kept per grid sample.

Kept is the *occluded* part of the Lambert transfer: the whole is the unshadowed part, which is known in closed form,
minus this. So whatever sees its whole hemisphere is exact, and only shadows carry the quadrature's error.
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
"""Points times directions of a piece that is worked on at once: it stays in the processor's cache."""
BATCH = 64
"""Pieces whose sums over the directions are one matrix product."""
LIFT_M = 1e-4
"""A sample buried less than this is still on the surface that is seen."""
FILL_PASSES = 2

Floats = NDArray[np.float32]


def bake(solids: list[Solid], atlas: list[list[Grid]], directions: Floats) -> Floats:
    """[total, 16] occluded Lambert transfer (1/pi included) of every grid sample, world axes.

    `directions` [n, 3] float32, unit, evenly spread over the sphere.
    """
    table = np.zeros((table_size(atlas), COEFFICIENTS), np.float32)
    for own, grids in enumerate(atlas):
        for part, grid in enumerate(grids):
            table[grid.offset : grid.offset + grid.size] = _bake_grid(solids, own, part, grid, directions)
    return table


def table_size(atlas: list[list[Grid]]) -> int:
    """Samples in all grids."""
    return atlas[-1][-1].offset + atlas[-1][-1].size


def blocked_directions(
    solids: Sequence[Solid],
    skip: Solid | None,
    points: Floats,
    directions: Floats,
    wanted: NDArray[np.bool_] | None = None,
) -> NDArray[np.bool_]:
    """[points, directions] True where any solid but `skip` stands in the way of unit `directions`.

    Points should lie near each other: that bounds which directions a solid can block. Only `wanted` [directions] are
    asked, the others stay False.
    """
    blocked = np.zeros((len(points), len(directions)), bool)
    middle = points.mean(axis=0)
    reach = float(np.linalg.norm(points - middle, axis=1).max())
    still_open = np.ones(len(directions), bool) if wanted is None else wanted
    for solid in solids:
        if solid is skip:
            continue
        asked = np.flatnonzero(still_open & directions_near(solid, middle, directions, reach))
        if asked.size:
            blocked[:, asked] |= solid.blocks(points, directions[asked])
        if solid.bounds is None:
            still_open = still_open & ~blocked.all(axis=0)
    return blocked


def directions_near(solid: Solid, middle: Floats, directions: Floats, reach: float) -> NDArray[np.bool_]:
    """[directions] which of them may meet the solid from within `reach` of `middle`."""
    everything = np.ones(len(directions), bool)
    if solid.bounds is None:
        return everything
    center, radius = solid.bounds
    offset = center - middle
    distance = float(np.linalg.norm(offset))
    if distance <= radius + reach:
        return everything
    cone = np.sqrt(1 - ((radius + reach) / distance) ** 2)
    near: NDArray[np.bool_] = directions @ (offset / distance).astype(np.float32) > cone - 1e-4
    return near


def seen_samples(solid: Solid, part: int, grid: Grid) -> tuple[Points, Points, Solid | None]:
    """Where shadow rays from a chart's grid start, the surface's normals there, and which solid they cannot meet."""
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
        lost = _lost(solids, skip, grid, [positions[p] for p in batch], [normals[p] for p in batch], directions)
        sums = np.split(lost @ weights, np.cumsum([buried[p].size for p in batch])[:-1])
        for piece, of_piece in zip(batch, sums, strict=True):
            values[piece] = of_piece.reshape(*buried[piece].shape, COEFFICIENTS)
    fill_buried(values, buried, grid.chart.wraps)
    return values.reshape(-1, COEFFICIENTS)


def _rises_above(solid: Solid, point: Points, normal: Points) -> bool:
    """Some of it may be above the horizon of a flat face."""
    return solid.bounds is None or bool((solid.bounds[0] - point) @ normal > -solid.bounds[1])


def _lost(
    solids: list[Solid],
    skip: Solid | None,
    grid: Grid,
    positions: list[Points],
    normals: list[Points],
    directions: Floats,
) -> Floats:
    """[samples, directions] 1 where a direction is blocked, times the cosine on surfaces that are not flat."""
    lost = []
    for places, ups in zip(positions, normals, strict=True):
        points = places.reshape(-1, 3).astype(np.float32)
        if grid.is_flat:
            lost.append(blocked_directions(solids, skip, points, directions).astype(np.float32))
        else:
            cosines = ups.reshape(-1, 3).astype(np.float32) @ directions.T
            facing: NDArray[np.bool_] = np.any(cosines > 0, axis=0)
            lost.append(blocked_directions(solids, skip, points, directions, facing) * np.maximum(cosines, 0))
    return np.concatenate(lost)


def tiles(grid: Grid, directions: int) -> list[tuple[slice, slice]]:
    """Pieces of a grid that are worked on at once with so many directions."""
    side = max(2, math.isqrt(RAYS_AT_ONCE // directions))
    starts = ((r, c) for r in range(0, grid.rows, side) for c in range(0, grid.columns, side))
    return [(slice(r, r + side), slice(c, c + side)) for r, c in starts]


def buried_samples(solids: list[Solid], own: int, part: int, grid: Grid) -> NDArray[np.bool_]:
    """[rows, columns] samples inside another solid or in an opening, which nobody sees."""
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
    """Give buried samples, in place, the mean of their neighbours that are not: interpolation near them reads both."""
    unknown = buried.copy()
    for _ in range(FILL_PASSES):
        known = (~unknown).astype(values.dtype)[..., None]
        total, count = _around(values * known, wraps), _around(known, wraps)
        fresh = unknown & (count[..., 0] > 0)
        values[fresh] = total[fresh] / count[fresh]
        unknown &= ~fresh


def _around(values: Floats, wraps: bool) -> Floats:
    """The sum over the 3x3 neighbourhood."""
    padded = np.pad(values, ((0, 0), (1, 1), (0, 0)), mode="wrap" if wraps else "constant")
    padded = np.pad(padded, ((1, 1), (0, 0), (0, 0)))
    rows, columns = values.shape[:2]
    total = np.zeros_like(values)
    for row, column in np.ndindex(3, 3):
        total += padded[row : row + rows, column : column + columns]
    return total
