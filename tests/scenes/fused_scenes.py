"""Scenes in closed form, the views they are fused from, and a new view of each."""

from __future__ import annotations

from protocol.frames import CameraModel
from tests.scenes.analytic import Floats, Shape, look_at, plane, room, sphere

CAMERA = CameraModel(width=97, height=71, fx=80.0, fy=78.0, cx=47.313, cy=36.127)
BOUNDS = (-1.5, -1.2, -1.5, 1.6, 1.3, 1.8)
ROOM = room((-1.3, -1.0, -1.3), (1.4, 1.1, 1.6))
BALL_CENTER, BALL_RADIUS = (0.1, 0.2, 0.3), 0.45
BALL = [ROOM, sphere(BALL_CENTER, BALL_RADIUS)]
PLANES = [
    plane((0, 0, 0.9), (0.5, 0.3, -1)),
    plane((0, 0.8, 0), (0.1, -1, 0.1)),
    plane((-0.9, 0, 0), (1, 0.15, -0.1)),
]
BALL_VIEWS = [
    look_at((0.75 + dx, -0.5 + dy, -0.7 - dx / 2), (0.0, 0.15, 0.3))
    for dx, dy in ((-0.35, 0.1), (0.35, -0.1), (0.0, 0.4), (-0.1, -0.3), (0.15, 0.1))
]
PLANES_VIEWS = [look_at((x, -0.3, -1.0), (0.05, 0.2, 0.6)) for x in (-0.4, -0.2, 0.0, 0.2, 0.4, 0.6)]
SCENES: dict[str, tuple[list[Shape], list[Floats], Floats]] = {
    "ball in a room": (BALL, BALL_VIEWS, look_at((0.72, -0.45, -0.75), (0.0, 0.15, 0.3))),
    "tilted planes": (PLANES, PLANES_VIEWS, look_at((0.3, 0.1, -0.9), (0.0, 0.3, 0.7))),
    "planes from outside": (PLANES, PLANES_VIEWS, look_at((0.25, -0.4, -2.1), (0.05, 0.2, 0.6))),
}
"""Shapes, the views that are fused, and the new view. A pixel is 0.3 voxels wide where the surface is."""
