"""A room with a black and a white half, lit from above and from the front.

With one constant albedo, the white half suggests light from the side of the black half: the hard case of B2.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from client.synthetic.scenes import textures
from client.synthetic.scenes.scene import Body, Scene
from client.synthetic.solids.polyhedra import Solid, box, rotation_about, wedge
from client.synthetic.solids.round import Cylinder, Sphere
from client.synthetic.solids.shell import Opening, Shell

BLACK, WHITE = 0.06, 0.75
"""Albedo at x < 0 and at x > 0."""


def halves() -> Scene:
    """4 x 2.6 x 3 m without ceiling and front; the same solids on both sides, two-coloured ones in the middle."""
    ceiling, front = Opening(3, (-2.0, -1.5), (2.0, 1.5)), Opening(5, (-2.0, 0.0), (2.0, 2.6))
    shell = Shell(np.array([-2, 0, -1.5]), np.array([2, 2.6, 1.5]), (ceiling, front))
    bodies = [Body(shell, half_black)]
    for side in (-1.0, 1.0):
        solids: list[Solid] = [
            box((1.55 * side, 0.4, -0.9), (0.5, 0.8, 0.7)),
            box((0.7 * side, 0.2, 0.2), (0.4, 0.4, 0.4), rotation_about("y", 30)),
            wedge((1.2 * side, 0, 0.3), (0.5, 0.4, 0.4), rotation_about("y", -40 * side)),
            Sphere(np.array([0.75 * side, 0.28, -0.75]), 0.28),
            Cylinder(np.array([1.6 * side, 0.0, 0.2]), np.array([0, 1.0, 0]), 0.6, 0.15),
        ]
        bodies += [Body(solid, half_black) for solid in solids]
    bodies.append(Body(Sphere(np.array([0.0, 0.22, -0.2]), 0.22), half_black))
    return Scene("halves", tuple(bodies), 0.025, 4096, _walk_along_front)


def half_black(points: textures.Values) -> textures.Values:
    """Albedo [n, 3] of world points [n, 3]."""
    return np.where(points[:, :1] < 0, BLACK, WHITE) * np.ones(3)


def _walk_along_front(time_s: float) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Back and forth along the open side, looking in."""
    sideways = -0.8 * np.cos(2 * np.pi * time_s / 8)
    return np.array([sideways, 1.5, 1.4]), np.array([0.2 * sideways, 0.5, -0.7])
