"""Light that surfaces send to each other, gathered at the samples of the grids: so that shadows are not black.

At each sample, rays with the cosine's density meet surfaces; what those send is their albedo times what arrives there:
from lamps and the sky at first, then also what this gathers. Between samples it is interpolated.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from client.synthetic.lighting.bake import buried_samples, fill_buried, seen_samples, table_size
from client.synthetic.lighting.lamps import Lamp, lamplight
from client.synthetic.lighting.lights import DistantLight
from client.synthetic.render import LitSolid, irradiance
from client.synthetic.solids.charts import Grid
from client.synthetic.solids.polyhedra import Solid

STEP_M = 0.08
"""Distance between samples: this light changes slowly from place to place."""
RAYS = 192
BOUNCES = 3
"""The fourth adds less than a display unit at albedos of 0.6."""
LIFT_M = 1e-4
_GOLDEN = np.pi * (3 - np.sqrt(5))

Floats = NDArray[np.float64]


def bounced(
    bodies: list[LitSolid], atlas: list[list[Grid]], lamps: tuple[Lamp, ...], light: DistantLight
) -> NDArray[np.float32]:
    """[total, 3] irradiance / pi from surfaces at all samples of the atlas, which has a row of grids for each body.

    Shadows of the sky's light must be in `bodies`.
    """
    solids = [body.solid for body in bodies]
    grids = [(own, part) for own, row in enumerate(atlas) for part in range(len(row))]
    meetings = [_Met(bodies, own, part, atlas[own][part]) for own, part in grids]
    direct = [met.albedo * met.lit(bodies, solids, lamps, light) for met in meetings]
    table = np.zeros((table_size(atlas), 3), np.float32)
    for _ in range(BOUNCES):
        last = table.copy()
        for met, sent in zip(meetings, direct, strict=True):
            met.write(table, sent + met.albedo * met.gathered(atlas, solids, last))
    return table


class _Met:
    """What the rays from the samples of one grid meet."""

    def __init__(self, bodies: list[LitSolid], own: int, part: int, grid: Grid) -> None:
        solids = [body.solid for body in bodies]
        self.grid = grid
        positions, normals = (of.astype(np.float64) for of in seen_samples(solids[own], part, self.grid)[:2])
        self._buried = buried_samples(solids, own, part, self.grid)
        self._shape = self._buried.shape
        rays = self._buried.size
        self.points, self.normals = np.zeros((rays * RAYS, 3)), np.zeros((rays * RAYS, 3))
        self.albedo, self.owner = np.zeros((rays * RAYS, 3)), np.full(rays * RAYS, -1)
        for sample, (position, normal) in enumerate(zip(positions.reshape(-1, 3), normals.reshape(-1, 3), strict=True)):
            if not self._buried.ravel()[sample]:
                self._trace(solids, slice(sample * RAYS, (sample + 1) * RAYS), position + LIFT_M * normal, normal)
        for number, body in enumerate(bodies):
            here = self.owner == number
            if here.any():
                self.normals[here] = body.solid.normals(self.points[here])
                assert body.texture is not None
                self.albedo[here] = body.texture(self.points[here])

    def _trace(self, solids: list[Solid], rays: slice, origin: Floats, normal: Floats) -> None:
        directions = _around(normal)
        nearest = np.full(RAYS, np.inf)
        owner = np.full(RAYS, -1)
        for number, solid in enumerate(solids):
            distance = solid.intersect(origin, directions)
            closer = distance < nearest
            nearest[closer], owner[closer] = distance[closer], number
        met = owner >= 0
        self.points[rays][met] = origin + nearest[met, None] * directions[met]
        self.owner[rays] = owner

    def lit(self, bodies: list[LitSolid], solids: list[Solid], lamps: tuple[Lamp, ...], light: DistantLight) -> Floats:
        """[rays, 3] irradiance / pi from lamps and the sky where the rays end."""
        arriving = np.zeros((len(self.points), 3))
        for number, body in enumerate(bodies):
            here = self.owner == number
            if here.any():
                points, normals = self.points[here], self.normals[here]
                arriving[here] = irradiance(body, points, normals, light) + lamplight(lamps, solids, points, normals)
        return arriving

    def gathered(self, atlas: list[list[Grid]], solids: list[Solid], table: NDArray[np.float32]) -> Floats:
        """[rays, 3] irradiance / pi from surfaces where the rays end."""
        found = np.zeros((len(self.points), 3))
        for number, solid in enumerate(solids):
            here = np.flatnonzero(self.owner == number)
            part = solid.part(self.points[here])
            for one in np.unique(part):
                there = here[part == one]
                found[there] = atlas[number][one].interpolate(table, self.points[there])
        return found

    def write(self, table: NDArray[np.float32], sent: Floats) -> None:
        """The mean over each sample's rays is its irradiance / pi."""
        values = sent.reshape(*self._shape, RAYS, 3).mean(axis=2).astype(np.float32)
        fill_buried(values, self._buried, self.grid.chart.wraps)
        table[self.grid.offset : self.grid.offset + self.grid.size] = values.reshape(-1, 3)


def _around(normal: Floats) -> Floats:
    """[RAYS, 3] unit directions with the density of the cosine to `normal`, the same for all samples."""
    number = np.arange(RAYS) + 0.5
    sine, angle = np.sqrt(number / RAYS), number * _GOLDEN
    side = np.cross(normal, [0.0, 1.0, 0.0] if abs(normal[1]) < 0.9 else [1.0, 0.0, 0.0])
    side /= np.linalg.norm(side)
    up = np.sqrt(1 - sine**2)[:, None] * normal
    directions: Floats = sine[:, None] * (
        np.cos(angle)[:, None] * side + np.sin(angle)[:, None] * np.cross(normal, side)
    )
    return np.asarray(directions + up)
