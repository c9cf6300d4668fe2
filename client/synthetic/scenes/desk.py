"""A desk in the corner of a room, lit by a lamp that stands on it and, weakly, from the room's open side.

For the demo: things on the desk cast shadows that a virtual thing among them must match.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from client.synthetic.lighting.lamps import WARM, Lamp
from client.synthetic.scenes import textures
from client.synthetic.scenes.scene import Body, Scene
from client.synthetic.solids.polyhedra import box, rotation_about
from client.synthetic.solids.round import Cylinder, Sphere
from client.synthetic.solids.shell import Opening, Shell

TOP_M = 0.74
"""Height of the desk's top."""
BULB_M = (0.42, TOP_M + 0.36, -0.3)
INTENSITY = 0.5
"""Radiance times m^2 of the strongest colour: the desk below the bulb is bright, but does not clip."""
FREE_M = (0.06, TOP_M, -0.27)
"""A place on the desk where nothing stands."""
PERIOD_S = 4.0

_UPWARDS = np.array([0.0, 1.0, 0.0])


def desk() -> Scene:
    """A corner of 2.6 x 2.2 x 2 m, open towards +z, with a desk at its back wall."""
    paint = textures.painted
    front = Opening(5, (-1.3, 0.0), (1.3, 2.2))
    shell = Shell(np.array([-1.3, 0, -0.75]), np.array([1.3, 2.2, 1.25]), (front,))
    bodies = [
        Body(shell, _walls),
        Body(box((0, TOP_M - 0.02, -0.37), (1.7, 0.04, 0.7)), textures.wood),
        Body(box((-0.82, 0.35, -0.37), (0.04, 0.7, 0.66)), textures.wood),
        Body(box((0.82, 0.35, -0.37), (0.04, 0.7, 0.66)), textures.wood),
        Body(box((-0.05, TOP_M + 0.56, -0.735), (0.5, 0.36, 0.03)), _picture),
        Body(box((-0.52, TOP_M + 0.02, -0.42), (0.26, 0.04, 0.19), rotation_about("y", 14)), paint(0.5, 0.12, 0.1)),
        Body(box((-0.51, TOP_M + 0.055, -0.42), (0.23, 0.03, 0.17), rotation_about("y", 6)), paint(0.16, 0.3, 0.42)),
        Body(box((-0.53, TOP_M + 0.09, -0.43), (0.24, 0.04, 0.16), rotation_about("y", 24)), paint(0.6, 0.5, 0.2)),
        Body(_standing(0.16, -0.12, 0.042, 0.095), paint(0.62, 0.6, 0.56)),
        Body(Sphere(np.array([-0.26, TOP_M + 0.055, -0.12]), 0.055), paint(0.7, 0.3, 0.08)),
        Body(_standing(-0.2, -0.58, 0.06, 0.11), paint(0.48, 0.26, 0.18)),
        Body(Sphere(np.array([-0.2, TOP_M + 0.16, -0.58]), 0.085), paint(0.14, 0.3, 0.1)),
        Body(_standing(0.52, -0.5, 0.08, 0.02), paint(0.2, 0.2, 0.22)),
        Body(_standing(0.52, -0.5, 0.011, 0.44), paint(0.2, 0.2, 0.22)),
        Body(_shade(), paint(0.55, 0.55, 0.5)),
    ]
    bulb = Lamp(np.array(BULB_M), INTENSITY * WARM**0.7)
    return Scene("desk", tuple(bodies), 0.02, 2048, _sway, brightness=0.4, lamps=(bulb,))


def _standing(x: float, z: float, radius_m: float, height_m: float) -> Cylinder:
    """Upright on the desk."""
    return Cylinder(np.array([x, TOP_M, z]), _UPWARDS, height_m, radius_m)


def _shade() -> Cylinder:
    """A disc over the bulb, which keeps its light from the upper walls."""
    return Cylinder(np.array(BULB_M) + 0.06 * _UPWARDS, _UPWARDS, 0.015, 0.1)


def _walls(points: textures.Values) -> textures.Values:
    """Plaster, and boards on the floor."""
    x, y, z = points.T
    plaster = (1 + 0.03 * np.sin(31 * x + 2 * np.sin(17 * y)) * np.sin(27 * y + z))[:, None] * np.array(
        [0.62, 0.6, 0.55]
    )
    boards = (0.8 + 0.12 * np.tanh(4 * np.sin(38 * x)))[:, None] * np.array([0.42, 0.3, 0.2])
    mixed: textures.Values = np.where((y < 1e-6)[:, None], boards, plaster)
    return mixed


def _picture(points: textures.Values) -> textures.Values:
    """A painted landscape in a dark frame."""
    x, y = (points[:, 0] + 0.05) / 0.25, (points[:, 1] - TOP_M - 0.56) / 0.18
    hill = 0.25 * np.sin(3.1 * x + 0.4) + 0.1 * np.sin(7.3 * x) - 0.15
    sky, ground = np.array([0.36, 0.5, 0.62]), np.array([0.2, 0.34, 0.14])
    ground_share = 0.5 - 0.5 * np.tanh((y - hill) / 0.06)
    inside = 0.5 - 0.5 * np.tanh((np.maximum(np.abs(x) - 0.9, np.abs(y) - 0.86)) / 0.02)
    painted = sky + (ground - sky) * ground_share[:, None]
    framed: textures.Values = 0.08 + (painted - 0.08) * inside[:, None]
    return framed


def _sway(time_s: float) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """A person before the desk, who looks at it and moves from side to side."""
    angle = 2 * np.pi * time_s / PERIOD_S
    position = np.array([-0.3 * np.cos(angle), 1.36 + 0.03 * np.sin(2 * angle), 0.68])
    return position, np.array([-0.04, TOP_M + 0.1, -0.3])
