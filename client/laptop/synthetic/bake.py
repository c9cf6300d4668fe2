"""Shadows of solids on each other, integrated once over the sphere of directions and kept per grid sample.

Kept is the *occluded* part of the Lambert transfer: the whole is the unshadowed part, which is known in closed form,
minus this. So whatever sees its whole hemisphere is exact, and only shadows carry the quadrature's error.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from client.laptop.synthetic.charts import Grid
from client.laptop.synthetic.harmonics import COEFFICIENTS, basis
from client.laptop.synthetic.shapes import Solid
from client.laptop.synthetic.shell import Shell

TILE = 8
"""Samples along each side of a piece that is worked on at once: it stays in the processor's cache."""
LIFT_M = 1e-4
"""A sample buried less than this is still on the surface that is seen."""
FILL_PASSES = 2

Floats = NDArray[np.float32]


def bake(solids: list[Solid], atlas: list[list[Grid]], directions: NDArray[np.float64]) -> Floats:
    """[total, 16] occluded Lambert transfer (1/pi included) of every grid sample, world axes."""
    table = np.zeros((atlas[-1][-1].offset + atlas[-1][-1].size, COEFFICIENTS), np.float32)
    for own, grids in enumerate(atlas):
        for grid in grids:
            table[grid.offset : grid.offset + grid.size] = _bake_grid(solids, own, grid, directions)
    return table


def blocked_directions(
    solids: list[Solid], skip: Solid | None, points: Floats, directions: Floats, reach: float
) -> NDArray[np.bool_]:
    """[points, directions] True where any solid but `skip` stands in the way of unit `directions`.

    The points lie within `reach` metres of their mean: that bounds which directions a solid can block.
    """
    blocked = np.zeros((len(points), len(directions)), bool)
    middle = points.mean(axis=0)
    still_open = np.ones(len(directions), bool)
    for solid in solids:
        if solid is skip:
            continue
        asked = np.flatnonzero(still_open & _directions_near(solid, middle, directions, reach))
        if asked.size:
            blocked[:, asked] |= solid.blocks(points, directions[asked])
        if solid.bounds is None:
            still_open = ~blocked.all(axis=0)
    return blocked


def _directions_near(solid: Solid, middle: Floats, directions: Floats, reach: float) -> NDArray[np.bool_]:
    """[directions] which of them may meet the solid."""
    everything = np.ones(len(directions), bool)
    if solid.bounds is None:
        return everything
    center, radius = solid.bounds
    offset = center - middle
    distance = float(np.linalg.norm(offset))
    if distance <= radius + reach:
        return everything
    cone = np.sqrt(1 - ((radius + reach) / distance) ** 2)
    return directions @ (offset / distance).astype(np.float32) > cone - 1e-4


def _bake_grid(solids: list[Solid], own: int, grid: Grid, directions: NDArray[np.float64]) -> Floats:
    positions, normals = grid.samples()
    buried = _buried(solids, own, positions, normals)
    values = np.zeros((grid.rows, grid.columns, COEFFICIENTS), np.float32)
    if not buried.all():
        for rows, columns in tiles(grid):
            if not buried[rows, columns].all():
                values[rows, columns] = _bake_tile(
                    solids, solids[own], grid, positions[rows, columns], normals[rows, columns], directions
                )
        fill_buried(values, buried, grid.chart.wraps)
    return values.reshape(-1, COEFFICIENTS)


def tiles(grid: Grid) -> list[tuple[slice, slice]]:
    """Pieces of a grid that are worked on at once."""
    starts = ((r, c) for r in range(0, grid.rows, TILE) for c in range(0, grid.columns, TILE))
    return [(slice(r, r + TILE), slice(c, c + TILE)) for r, c in starts]


def _bake_tile(
    solids: list[Solid], own: Solid, grid: Grid, positions: NDArray, normals: NDArray, directions: NDArray
) -> Floats:
    points, up = positions.reshape(-1, 3), normals.reshape(-1, 3)
    if grid.is_flat:
        up = up[:1]
    facing = directions[(directions @ up.T > 0).any(axis=1)]
    reach = float(np.linalg.norm(points - points.mean(axis=0), axis=1).max())
    # A convex solid does not shadow itself, and a flat chart of any cannot be below its own horizon.
    skip = own if own.bounds is not None else None
    blocked = blocked_directions(solids, skip, points.astype(np.float32), facing.astype(np.float32), reach)
    cosines = np.maximum(up.astype(np.float32) @ facing.astype(np.float32).T, 0)
    weights = (basis(facing) * (4 / len(directions))).astype(np.float32)  # 4 pi / n of solid angle each, over pi
    if len(cosines) == 1:
        lost = blocked.astype(np.float32) @ (cosines.T * weights)
    else:
        lost = (blocked * cosines) @ weights
    return lost.reshape(*positions.shape[:2], COEFFICIENTS)


def _buried(solids: list[Solid], own: int, positions: NDArray, normals: NDArray) -> NDArray[np.bool_]:
    """[rows, columns] samples inside another solid or in an opening, which nobody sees."""
    lifted = (positions + LIFT_M * normals).reshape(-1, 3)
    inside = np.zeros(len(lifted), bool)
    for number, solid in enumerate(solids):
        if number != own:
            inside |= solid.contains(lifted)
        elif isinstance(solid, Shell):
            inside |= solid.absent(positions.reshape(-1, 3))
    return inside.reshape(positions.shape[:2])


def fill_buried(values: NDArray, buried: NDArray[np.bool_], wraps: bool) -> None:
    """Give buried samples, in place, the mean of their neighbours that are not: interpolation near them reads both."""
    unknown = buried.copy()
    for _ in range(FILL_PASSES):
        known = (~unknown).astype(values.dtype)[..., None]
        total, count = _around(values * known, wraps), _around(known, wraps)
        fresh = unknown & (count[..., 0] > 0)
        values[fresh] = total[fresh] / count[fresh]
        unknown &= ~fresh


def _around(values: NDArray, wraps: bool) -> NDArray:
    """The sum over the 3x3 neighbourhood."""
    padded = np.pad(values, ((0, 0), (1, 1), (0, 0)), mode="wrap" if wraps else "constant")
    padded = np.pad(padded, ((1, 1), (0, 0), (0, 0)))
    rows, columns = values.shape[:2]
    return sum(padded[r : r + rows, c : c + columns] for r in range(3) for c in range(3))
