"""The stage set: a small paper-model city on a plate, similar to the City of Sights (thesis 3.3).

The buildings are fixed; appearance.py has their textures.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from client.synthetic.scenes.appearance import APPEARANCES, Convex, StageSurface
from client.synthetic.scenes.scene import Body, Scene
from client.synthetic.solids.carved import Carved
from client.synthetic.solids.polyhedra import Polyhedron, box, rotation_about
from client.synthetic.solids.prisms import Place, frustum, gable
from client.synthetic.solids.round import Cylinder, Sphere

PLATE_M = (0.8, 0.03, 0.6)
"""Its top is y = 0, its middle x = z = 0."""
ROUND_S = 12.0
"""Duration of one walk around the set."""

Floats = NDArray[np.float64]
Parts = Iterator[tuple[Convex | Carved, str]]
"""Each solid of a building and its role: wall, stone, roof, dome or ground."""


def stage(appearance: str = "paper", is_still: bool = False) -> Scene:
    """The set with an appearance of APPEARANCES; the camera walks around it, or stays at the start of that path."""
    plate = box((0, -PLATE_M[1] / 2, 0), PLATE_M)
    bodies = [Body(plate, APPEARANCES[appearance](StageSurface("ground", 0, plate, np.eye(3))))]
    for number, (site, building) in enumerate(BUILDINGS, 1):
        for solid, role in building(site):
            bodies.append(Body(solid, APPEARANCES[appearance](StageSurface(role, number, solid, site.rotation))))
    return Scene("stage", tuple(bodies), 0.0035, 3072, _stand if is_still else _walk_around)


@dataclass(frozen=True)
class Site:
    """Position in metres and rotation about y of a building; shapes are given in its frame."""

    x: float
    z: float
    yaw_deg: float

    @cached_property
    def rotation(self) -> Floats:
        return rotation_about("y", self.yaw_deg)

    def at(self, x: float, y: float, z: float) -> Place:
        """A point of the building's frame in world metres."""
        right, up, front = self.rotation @ np.array([x, y, z])
        return self.x + float(right), float(up), self.z + float(front)

    def block(self, foot: Place, size: tuple[float, float, float]) -> Polyhedron:
        """A box, positioned by the centre of its bottom face."""
        x, y, z = foot
        return box(self.at(x, y + size[1] / 2, z), size, self.rotation)

    def roof(self, foot: Place, size: tuple[float, float, float]) -> Polyhedron:
        return gable(self.at(*foot), size, self.rotation)

    def shaft(self, foot: Place, sides: int, radii: tuple[float, float], height: float) -> Polyhedron:
        return frustum(self.at(*foot), sides, radii, height, self.rotation)

    def column(self, foot: Place, radius: float, height: float) -> Cylinder:
        return Cylinder(np.array(self.at(*foot)), np.array([0, 1.0, 0]), height, radius)

    def ball(self, center: Place, radius: float) -> Sphere:
        return Sphere(np.array(self.at(*center)), radius)


def _pyramid(site: Site) -> Parts:
    for step in range(5):
        side = 0.2 - 0.038 * step
        yield site.block((0, 0.028 * step, 0), (side, 0.028, side)), "stone"


def _gate(site: Site) -> Parts:
    radius, spring, width, depth = 0.036, 0.05, 0.16, 0.056
    leg = width / 2 - radius
    for side in (-1, 1):
        yield site.block((side * (radius + leg / 2), 0, 0), (leg, spring, depth)), "stone"
    hole = Cylinder(np.array(site.at(0, spring, -depth)), site.rotation[:, 2], 2 * depth, radius)
    yield Carved(site.block((0, spring, 0), (width, 0.06, depth)), hole), "stone"
    yield site.block((0, spring + 0.06, 0), (width + 0.012, 0.008, depth + 0.012)), "roof"
    yield site.block((0, spring + 0.068, 0), (width - 0.02, 0.024, depth - 0.01)), "wall"


def _domed_tower(site: Site) -> Parts:
    yield site.block((0, 0, 0), (0.13, 0.05, 0.13)), "wall"
    yield site.block((0, 0.05, 0), (0.138, 0.006, 0.138)), "stone"
    yield site.column((0, 0.056, 0), 0.05, 0.075), "wall"
    yield site.column((0, 0.131, 0), 0.055, 0.006), "stone"
    yield site.ball((0, 0.137, 0), 0.05), "dome"
    yield site.column((0, 0.18, 0), 0.012, 0.026), "stone"
    yield site.shaft((0, 0.206, 0), 8, (0.015, 0), 0.028), "roof"


def _hall(site: Site) -> Parts:
    yield site.block((0.03, 0, 0), (0.17, 0.075, 0.1)), "wall"
    yield site.roof((0.03, 0.075, 0), (0.18, 0.055, 0.116)), "roof"
    yield site.block((-0.08, 0, 0), (0.056, 0.145, 0.056)), "wall"
    yield site.shaft((-0.08, 0.145, 0), 4, (0.044, 0), 0.075), "roof"


def _obelisk(site: Site) -> Parts:
    yield site.block((0, 0, 0), (0.07, 0.01, 0.07)), "stone"
    yield site.block((0, 0.01, 0), (0.046, 0.018, 0.046)), "stone"
    yield site.shaft((0, 0.028, 0), 4, (0.024, 0.015), 0.13), "wall"
    yield site.shaft((0, 0.158, 0), 4, (0.015, 0), 0.02), "roof"


def _temple(site: Site) -> Parts:
    yield site.block((0, 0, 0), (0.2, 0.012, 0.13)), "stone"
    yield site.block((0, 0.012, 0), (0.06, 0.075, 0.05)), "wall"
    for x in (-0.085, -0.0283, 0.0283, 0.085):
        for z in (-0.05, 0.05):
            yield site.column((x, 0.012, z), 0.0095, 0.075), "stone"
    for x in (-0.085, 0.085):
        yield site.column((x, 0.012, 0), 0.0095, 0.075), "stone"
    yield site.block((0, 0.087, 0), (0.195, 0.014, 0.125)), "stone"
    yield site.roof((0, 0.101, 0), (0.2, 0.036, 0.135)), "roof"


def _arena(site: Site) -> Parts:
    outer, hole = site.column((0, 0, 0), 0.082, 0.055), site.column((0, 0.01, 0), 0.06, 0.1)
    yield Carved(outer, hole), "wall"
    yield site.block((0, 0.01, -0.01), (0.03, 0.012, 0.03)), "stone"


def _city_wall(site: Site) -> Parts:
    yield site.block((0, 0, 0), (0.24, 0.06, 0.02)), "wall"
    for side in (-1, 1):
        yield site.column((side * 0.12, 0, 0), 0.024, 0.085), "wall"
        yield site.shaft((side * 0.12, 0.085, 0), 12, (0.03, 0), 0.04), "roof"


BUILDINGS: tuple[tuple[Site, Callable[[Site], Parts]], ...] = (
    (Site(-0.27, -0.15, 12), _pyramid),
    (Site(-0.1, 0.03, 28), _gate),
    (Site(0.27, -0.17, -8), _domed_tower),
    (Site(0.03, -0.15, -20), _hall),
    (Site(0.1, 0.03, 45), _obelisk),
    (Site(0.26, 0.12, -28), _temple),
    (Site(-0.28, 0.16, 0), _arena),
    (Site(0.1, -0.27, 0), _city_wall),
)


def _walk_around(time_s: float) -> tuple[Floats, Floats]:
    """Once around the set, with the sway of a walking person."""
    azimuth = 2 * np.pi * time_s / ROUND_S
    height = 0.54 + 0.015 * np.sin(2 * np.pi * time_s / 1.1)
    away = 0.88 + 0.03 * np.sin(2 * np.pi * time_s / 4)
    return np.array([away * np.sin(azimuth), height, away * np.cos(azimuth)]), np.array([0, -0.01, 0])


def _stand(_time_s: float) -> tuple[Floats, Floats]:
    return _walk_around(0.0)
