"""A furnished room whose depth is known in closed form, as frames of a camera that walks about in it."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from protocol.frames import CameraModel, RgbdFrame
from protocol.messages import Wishes
from tests.scenes.analytic import Floats, Shape, look, look_at, room, sphere
from tests.scenes.plain_light import PLAIN_LIGHT

CAMERA = CameraModel(width=160, height=120, fx=140.0, fy=140.0, cx=79.5, cy=59.5)
VOXEL_M = 0.02
BOUNDS = (-2.2, -1.1, -0.6, 2.2, 1.1, 2.6)
ROOM: list[Shape] = [
    room((-2.1, -1.0, -0.5), (2.1, 1.0, 2.5)),
    sphere((-1.0, 0.6, 1.6), 0.4),
    sphere((-0.3, 0.7, 1.3), 0.3),
    sphere((-1.7, 0.2, 2.0), 0.35),
    sphere((1.2, 0.7, 1.5), 0.3),
    sphere((1.8, -0.2, 1.2), 0.3),
]


def wishes(poses: str, **more: object) -> Wishes:
    """Of the plain model of light, unless `more` names another."""
    return Wishes(poses=poses, volume_m=BOUNDS, voxel_m=VOXEL_M, **{**PLAIN_LIGHT, **more})  # type: ignore[arg-type]


def view_at(step: float) -> Floats:
    """world_from_camera on a smooth way before the left half of the room; about 2 cm and 1 degree a step."""
    angle = 0.05 * step
    eye = (-0.9 + 0.4 * np.sin(angle), -0.1 + 0.15 * np.sin(1.7 * angle), 0.2 * (1 - np.cos(angle)))
    return look_at(eye, (-0.9 + 0.2 * np.sin(0.8 * angle), 0.4, 1.5))


def frame_at(
    view: Floats,
    index: int = 0,
    *,
    noise_m: float = 0.0,
    scene: list[Shape] | None = None,
    given: ArrayLike | None = None,
) -> RgbdFrame:
    """What the camera sees from `view`, in whole millimetres; `given`: the pose that the client names."""
    truth = look(ROOM if scene is None else scene, CAMERA, view)
    depth = truth.depth_m + np.random.default_rng(index).normal(0, noise_m, truth.depth_m.shape)
    x, y, z = np.moveaxis(np.where(truth.depth_m[..., None] > 0, truth.points, 0), -1, 0)
    pattern = (np.sin(7 * x) + np.sin(9 * y + 1) + np.sin(8 * z + 2)) / 3
    shade = 0.6 + 0.4 * np.abs(truth.normals @ np.array([0.4, 0.7, 0.6]))
    color = np.clip(255 * shade * (0.6 + 0.3 * pattern), 0, 255).astype(np.uint8)
    units: NDArray[np.uint16] = np.rint(1000 * np.where(truth.depth_m > 0, depth, 0)).clip(0, 65535).astype(np.uint16)
    pose = None if given is None else np.asarray(given, np.float64)
    return RgbdFrame(index, index / 30, np.repeat(color[..., None], 3, axis=-1), units, pose)
