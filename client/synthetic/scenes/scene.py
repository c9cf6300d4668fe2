"""Description of a scene, and the scenes table and room."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from client.synthetic.lighting.lamps import Lamp
from client.synthetic.scenes import textures
from client.synthetic.solids.polyhedra import Solid, box, rotation_about, wedge
from client.synthetic.solids.round import Cylinder, Sphere
from client.synthetic.solids.shell import Opening, Shell

DIM_SKY = 0.2
"""Brightness of the sky if the room is lit by lamps."""


@dataclass(frozen=True)
class Body:
    """A solid and its texture."""

    solid: Solid
    texture: textures.Texture
    """Used only with the option `texture`."""


@dataclass(frozen=True)
class Scene:
    """Static solids and the camera path."""

    name: str
    bodies: tuple[Body, ...]
    step_m: float
    """Distance between samples of precomputed shadows."""
    directions: int
    """Number of directions of the quadrature over the sphere."""
    camera_path: Callable[[float], tuple[NDArray[np.float64], NDArray[np.float64]]]
    """Seconds -> (position, target), metres."""
    brightness: float = 1.0
    """Factor of the light; larger for rooms, which admit less of it."""
    lamps: tuple[Lamp, ...] = ()
    """Lamps that belong to the scene. Where there are any, surfaces light each other too (lighting/bounced.py)."""

    @property
    def solids(self) -> list[Solid]:
        return [body.solid for body in self.bodies]


def table() -> Scene:
    """A table top of 1.2 x 0.8 m at y = 0 with objects of many slopes; nothing around it."""
    wood, paint = textures.wood, textures.painted
    standing = rotation_about("y", 35)
    leaning = rotation_about("y", -25) @ rotation_about("z", 28)
    bodies = (
        Body(box((0, -0.02, 0), (1.2, 0.04, 0.8)), wood),
        Body(box((-0.33, 0.11, -0.14), (0.2, 0.22, 0.16), standing), paint(0.72, 0.2, 0.16)),
        Body(box((0.24, 0.085, -0.22), (0.22, 0.12, 0.14), leaning), paint(0.2, 0.42, 0.7)),
        Body(Sphere(np.array([-0.04, 0.11, -0.24]), 0.11), paint(0.72, 0.68, 0.3)),
        Body(Sphere(np.array([0.36, 0.06, 0.1]), 0.06), paint(0.3, 0.65, 0.3)),
        Body(Cylinder(np.array([0.46, 0.0, -0.1]), np.array([0, 1.0, 0]), 0.2, 0.05), paint(0.7, 0.6, 0.55)),
        Body(Cylinder(np.array([-0.5, 0.045, 0.14]), _unit(1, 0, 0.5), 0.22, 0.045), paint(0.6, 0.3, 0.6)),
        Body(wedge((-0.16, 0, 0.2), (0.24, 0.11, 0.15), rotation_about("y", 65)), paint(0.35, 0.6, 0.62)),
    )
    return Scene("table", bodies, 0.004, 4096, _walk_around_table)


def room() -> Scene:
    """A room of 4 x 2.6 x 3 m, open towards +z and with a window in its ceiling, and furniture."""
    paint = textures.painted
    front = Opening(5, (-2.0, 0.0), (2.0, 2.6))
    window = Opening(3, (-1.3, -1.0), (0.1, 0.2))
    shell = Shell(np.array([-2, 0, -1.5]), np.array([2, 2.6, 1.5]), (front, window))
    bodies = (
        Body(shell, textures.wallpaper),
        Body(box((-1.1, 0.21, -1.05), (1.6, 0.42, 0.8)), textures.cloth),
        Body(box((-1.1, 0.6, -1.36), (1.6, 0.36, 0.2)), textures.cloth),
        Body(box((-1.8, 0.52, -1.05), (0.2, 0.2, 0.8)), textures.cloth),
        Body(box((-0.9, 0.2, 0.1), (0.9, 0.06, 0.5), rotation_about("y", 12)), textures.wood),
        Body(box((-0.9, 0.085, 0.1), (0.5, 0.17, 0.25), rotation_about("y", 12)), textures.wood),
        Body(box((1.72, 0.95, -0.6), (0.5, 1.9, 0.9)), textures.wood),
        Body(box((0.75, 0.36, -1.15), (0.9, 0.72, 0.6)), paint(0.6, 0.62, 0.66)),
        Body(box((0.7, 0.9, -1.2), (0.4, 0.3, 0.06), rotation_about("x", -12)), paint(0.1, 0.12, 0.15)),
        Body(box((0.6, 0.16, 0.1), (0.4, 0.32, 0.4), rotation_about("y", 30)), paint(0.7, 0.5, 0.2)),
        Body(Sphere(np.array([0.6, 0.47, 0.1]), 0.15), paint(0.7, 0.25, 0.2)),
        Body(Cylinder(np.array([1.2, 0.0, 0.35]), np.array([0, 1.0, 0]), 0.45, 0.17), paint(0.25, 0.5, 0.35)),
    )
    return Scene("room", bodies, 0.025, 6144, _walk_in_room, brightness=1.5)


def lamp_room() -> Scene:
    """The room under a dim sky, lit mainly by its lamps (lighting/lamps.py)."""
    return replace(room(), brightness=DIM_SKY)


def _walk_around_table(time_s: float) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """An arc of 70 degrees at 1.25 m, back and forth in 6 s, with the sway of a walking person."""
    azimuth = np.radians(-35 * np.cos(2 * np.pi * time_s / 6))
    distance = 1.12 + 0.05 * np.sin(2 * np.pi * time_s / 4)
    height = 0.62 + 0.02 * np.sin(2 * np.pi * time_s / 1.1)
    position = np.array([distance * np.sin(azimuth), height, distance * np.cos(azimuth)])
    return position, np.array([0.02 * np.sin(2 * np.pi * time_s / 3), 0.02, -0.02])


def _walk_in_room(time_s: float) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Along the open side, looking in."""
    sideways = -1.0 * np.cos(2 * np.pi * time_s / 8)
    height = 1.5 + 0.02 * np.sin(2 * np.pi * time_s / 1.1)
    position = np.array([sideways, height, 1.42 - 0.15 * sideways**2])
    return position, np.array([0.25 * sideways, 0.75, -0.9])


def _unit(x: float, y: float, z: float) -> NDArray[np.float64]:
    vector = np.array([x, y, z], float)
    unit: NDArray[np.float64] = vector / np.linalg.norm(vector)
    return unit
