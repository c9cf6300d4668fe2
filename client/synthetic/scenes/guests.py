"""Guests: objects inserted into the stage set, real in one sequence and virtual in another, for ground truth.

Shadows of guests are stored apart from those of the set, so that unaffected pixels are equal bit for bit.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from client.synthetic.lighting.bake import (
    bake,
    blocked_directions,
    buried_samples,
    directions_near,
    fill_buried,
    seen_samples,
    table_size,
    tiles,
)
from client.synthetic.lighting.harmonics import COEFFICIENTS, basis
from client.synthetic.solids.charts import Grid, atlas
from client.synthetic.solids.polyhedra import Polyhedron, Solid, box, rotation_about
from client.synthetic.solids.round import Sphere

Floats = NDArray[np.float32]
STEP_M = 0.002
"""Distance between samples of shadows on guests."""


@dataclass(frozen=True)
class Guest:
    """An inserted object of one colour."""

    name: str
    solid: Sphere | Polyhedron
    srgb: tuple[int, int, int]
    """8-bit sRGB, as in a mesh file."""

    @property
    def albedo(self) -> NDArray[np.float64]:
        """[3] linear."""
        encoded = np.array(self.srgb) / 255
        return np.where(encoded <= 0.04045, encoded / 12.92, ((encoded + 0.055) / 1.055) ** 2.4)

    def texture(self, points: NDArray[np.floating]) -> NDArray[np.floating]:
        """[n, 3] linear albedo at points [n, 3]."""
        return np.broadcast_to(self.albedo, points.shape)


_BALL = Guest("ball", Sphere(np.array([0.05, 0.045, 0.2]), 0.045), (212, 178, 120))
_CRATE = Guest("crate", box((-0.07, 0.03, 0.19), (0.06, 0.06, 0.06), rotation_about("y", 25)), (190, 62, 48))

GUESTS: dict[str, tuple[Guest, ...]] = {"none": (), "ball": (_BALL,), "crate": (_CRATE,), "both": (_BALL, _CRATE)}


def guest_grids(guests: tuple[Guest, ...]) -> list[list[Grid]]:
    """Grids over the surfaces of the guests."""
    return atlas([guest.solid.charts for guest in guests], STEP_M)


def bake_guests(
    guests: tuple[Guest, ...], solids: list[Solid], grids: list[list[Grid]], directions: Floats
) -> dict[str, Floats]:
    """Occluded Lambert transfer: `on_set` [total, 16] due to guests only, `on_guests` [total, 16] on the guests.

    `grids`: over `solids`; `directions` [n, 3] float32, unit, of equal solid angle.
    """
    guest_solids: list[Solid] = [guest.solid for guest in guests]
    on_set = np.zeros((table_size(grids), COEFFICIENTS), np.float32)
    for own, of_solid in enumerate(grids):
        for part, grid in enumerate(of_solid):
            on_set[grid.offset : grid.offset + grid.size] = _occluded_by_guests(
                guest_solids, solids, own, part, grid, directions
            )
    return {"on_set": on_set, "on_guests": bake([*guest_solids, *solids], guest_grids(guests), directions)}


def _occluded_by_guests(
    guest_solids: list[Solid], solids: list[Solid], own: int, part: int, grid: Grid, directions: Floats
) -> Floats:
    """[samples, 16] of one grid; 0 where guests block no direction that is otherwise open."""
    positions, normals, skip = seen_samples(solids[own], part, grid)
    values = np.zeros((grid.rows, grid.columns, COEFFICIENTS), np.float32)
    for piece in tiles(grid, len(directions)):
        points, up = (of[piece].reshape(-1, 3).astype(np.float32) for of in (positions, normals))
        near = directions[_may_meet_guest(guest_solids, points, up, directions)]
        blocked = blocked_directions(guest_solids, None, points, near)
        blocked[:, blocked.any(axis=0)] &= ~blocked_directions(solids, skip, points, near[blocked.any(axis=0)])
        if blocked.any():
            occlusion = blocked * np.maximum(up @ near.T, 0)
            values[piece] = (occlusion @ basis(near)).reshape(values[piece].shape) * np.float32(4 / len(directions))
    if values.any():
        fill_buried(values, buried_samples([*solids, *guest_solids], own, part, grid), grid.chart.wraps)
    return values.reshape(-1, COEFFICIENTS)


def _may_meet_guest(guest_solids: list[Solid], points: Floats, up: Floats, directions: Floats) -> NDArray[np.bool_]:
    """[directions] which may hit a guest above the horizon of any of the points."""
    middle = points.mean(axis=0)
    radius_of_points = float(np.linalg.norm(points - middle, axis=1).max())
    near = np.zeros(len(directions), bool)
    for solid in guest_solids:
        near |= directions_near(solid, middle, directions, radius_of_points)
    near[near] = (up @ directions[near].T > 0).any(axis=0)
    return near
