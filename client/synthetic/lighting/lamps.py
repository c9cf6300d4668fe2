"""Lamps inside a scene: isotropic point lights, each in a small visible bulb.

Direct light with shadows of all solids is exact. Shadows of the bulbs in distant light are not modelled.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from client.synthetic.solids.polyhedra import Solid
from client.synthetic.solids.round import Sphere

BULB_RADIUS_M = 0.03
WARM = np.array([1.0, 0.76, 0.5])
INTENSITY = 2.4
"""Radiance times m^2 of the strongest colour: a facing surface at 1 m has radiance 0.76 * albedo."""
PLACES_M = (
    (0.55, 1.15, -0.85),
    (-0.6, 1.3, -0.3),
    (-1.2, 2.2, 0.9),
    (1.2, 1.9, 0.8),
    (0.1, 0.9, 0.4),
    (-0.3, 1.7, -0.6),
    (1.1, 1.3, -0.2),
    (-1.72, 1.0, -0.4),
)
"""Positions in the room: 0 above the desk, 1 above the low table, 2 and 3 out of view, 7 near a wall."""

Floats = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Lamp:
    """An isotropic point light."""

    position: Floats
    """[3] world, metres."""
    intensity: Floats
    """[3] radiant intensity, linear RGB: radiance in picture units times m^2."""

    @cached_property
    def bulb(self) -> Sphere:
        """The visible bulb."""
        return Sphere(self.position, BULB_RADIUS_M)

    @property
    def radiance(self) -> Floats:
        """[3] radiance of the bulb: intensity over the area of its disc."""
        return self.intensity / (np.pi * BULB_RADIUS_M**2)


def room_lamps(count: int, place: int) -> tuple[Lamp, ...]:
    """`count` lamps of the room, the first at position `place`; each next one three positions on, whiter and weaker."""
    return tuple(
        Lamp(np.array(PLACES_M[(place + 3 * k) % len(PLACES_M)]), INTENSITY * 0.8**k * WARM ** (1 - 0.5 * k))
        for k in range(count)
    )


def lamplight(lamps: Sequence[Lamp], solids: Sequence[Solid], points: Floats, normals: Floats) -> Floats:
    """[n, 3] irradiance / pi of the lamps at surface points."""
    arriving = np.zeros((len(points), 3))
    for lamp in lamps:
        obstacles = [*solids, *(other.bulb for other in lamps if other is not lamp)]
        away = points - lamp.position
        squared = (away * away).sum(axis=1)
        cosine = np.maximum(-(away * normals).sum(axis=1), 0) / np.sqrt(squared)
        share = cosine / (np.pi * squared) * _is_visible(lamp, obstacles, away)
        arriving += share[:, None] * lamp.intensity
    return arriving


def _is_visible(lamp: Lamp, solids: Sequence[Solid], away: Floats) -> NDArray[np.bool_]:
    """[n] whether the points at lamp position + `away` [n, 3] are visible from the lamp."""
    nearest = np.full(len(away), np.inf)
    for solid in solids:
        nearest = np.minimum(nearest, solid.intersect(lamp.position, away))
    return nearest > 1 - 1e-6  # the surface itself is at 1
