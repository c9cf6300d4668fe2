"""A scene and a camera that moves in it, for tracking."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from protocol.frames import CameraModel
from server.maths.registration import motion_of_twist
from server.opencl.engine import Engine
from server.tracking.track import (
    Registration,
    ViewBuffers,
    depth_pyramid,
    register,
    view_model,
)
from server.volume.raycast import Surface, raycast
from server.volume.volume import Volume
from tests.scenes.analytic import Floats, Shape, look, look_at, plane, room, sphere
from tests.scenes.volumes import fuse, upload_depth

CAMERA = CameraModel(width=160, height=120, fx=140.0, fy=140.0, cx=79.5, cy=59.5)
BOUNDS = (-1.2, -1.0, -0.5, 1.2, 1.0, 2.1)
VOXEL_M = 0.016
SCENE: list[Shape] = [
    room((-1.1, -0.9, -0.4), (1.1, 0.8, 2.0)),
    sphere((0.25, 0.4, 1.3), 0.35),
    sphere((-0.5, 0.5, 1.5), 0.25),
]
START = look_at((0.0, -0.2, 0.0), (0.05, 0.25, 1.3))


@dataclass
class World:
    """A volume fused from one view, and that view of it."""

    engine: Engine
    volume: Volume
    camera: CameraModel
    model: Surface
    pose: Floats
    """volume_from_camera of the view."""

    def register(self, depth_m: Floats, guess: Floats) -> Registration | None:
        """Depth [h, w] laid on the model from world_from_camera."""
        view = view_model(self.engine, self.camera, self.pose, self.model, ViewBuffers(self.engine.workspace))
        pyramid = depth_pyramid(self.engine, self.camera, upload_depth(self.engine, depth_m))
        start = self.volume.volume_from_world() @ guess
        return register(self.engine, self.camera, view, pyramid, start, 0.25 * VOXEL_M)


def world(engine: Engine, scene: list[Shape] | None = None, camera: CameraModel = CAMERA) -> World:
    scene = SCENE if scene is None else scene
    volume = Volume(engine, BOUNDS, VOXEL_M)
    for _ in range(3):
        fuse(engine, volume, camera, START, look(scene, camera, START).depth_m)
    pose = volume.volume_from_world() @ START
    return World(engine, volume, camera, raycast(engine, camera, pose, volume), pose)


def moved(turn_rad: float, shift_m: float, seed: int) -> Floats:
    """START after a motion of this size in some direction."""
    directions = np.random.default_rng(seed).normal(size=(2, 3))
    directions /= np.linalg.norm(directions, axis=1)[:, None]
    return START @ motion_of_twist(np.concatenate([turn_rad * directions[0], shift_m * directions[1]]))


FLOOR, CEILING, WALL = (
    plane((0, 0.6, 0), (0, -1, 0)),
    plane((0, -0.7, 0), (0, 1, 0)),
    plane((0.9, 0, 1.4), (-1, 0, -0.6)),
)
FLAT: dict[str, tuple[list[Shape], int]] = {
    "plane": ([plane((0, 0, 1.3), (0.2, 0.1, -1.0))], 3),
    "corridor": ([FLOOR, CEILING, WALL], 1),
    "two planes": ([plane((0, 0.5, 0), (0, -1, 0)), plane((0, 0, 1.5), (0, 0, -1))], 1),
    "sphere": ([sphere((0.1, 0.2, 1.3), 0.5)], 3),
}
