"""A camera with two lenses before an exact scene: what each sees, and what both do."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from msgspec.structs import replace
from numpy.typing import NDArray

from protocol.frames import CameraModel, DepthCamera
from tests.scenes.analytic import Floats, Shape, look, look_at, room, sphere

LENS = DepthCamera(
    width=80, height=60, fx=66.0, fy=65.0, cx=39.2, cy=30.1, distortion=(-0.21, 0.07, 0.001, -0.0008, -0.01)
)


def moved(offset_m: tuple[float, float, float], turn_rad: tuple[float, float, float] = (0, 0, 0)) -> tuple[float, ...]:
    """color_from_depth, row-major."""
    pose = np.eye(4)
    pose[:3, :3] = cv2.Rodrigues(np.array(turn_rad, np.float64))[0]
    pose[:3, 3] = offset_m
    return tuple(pose.ravel().tolist())


CAMERA = CameraModel(
    width=160,
    height=120,
    fx=140.0,
    fy=139.0,
    cx=80.3,
    cy=58.9,
    depth_scale_m=0.0001,
    depth=replace(LENS, color_from_depth=moved((0.05, -0.01, 0.004), (0.01, -0.03, 0.02))),
)
WORLD_FROM_COLOR = look_at((0.1, 0.0, -1.5), (0.0, 0.1, 0.5))
ROOM: Shape = room((-1.6, -1.2, -2.0), (1.6, 1.2, 1.3))
BALL: Shape = sphere((0.05, 0.1, 0.1), 0.35)


def opencv_rays(lens: DepthCamera) -> Floats:
    """[h, w, 3] rays of the distorted picture's pixels, z = 1."""
    matrix = np.array([[lens.fx, 0, lens.cx], [0, lens.fy, lens.cy], [0, 0, 1]])
    pixels = np.mgrid[: lens.height, : lens.width][::-1].reshape(2, -1).T.astype(np.float64)
    stop = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 200, 1e-12)
    rays = cv2.undistortPoints(pixels[:, None], matrix, np.array(lens.distortion), criteria=stop)[:, 0]
    return np.concatenate([rays, np.ones((len(rays), 1))], -1).reshape(lens.height, lens.width, 3)


def seen_by_depth(camera: CameraModel, scene: Sequence[Shape], world_from_color: Floats) -> NDArray[np.uint16]:
    """What the depth lens measures of a scene."""
    assert camera.depth is not None
    world_from_depth = world_from_color @ camera.color_from_depth
    rays = opencv_rays(camera.depth) @ world_from_depth[:3, :3].T
    depth = np.min([shape(world_from_depth[:3, 3], rays)[0] for shape in scene], axis=0)
    return np.where(np.isfinite(depth), np.rint(depth / camera.depth_scale_m), 0).astype(np.uint16)


def is_seen_by_both(camera: CameraModel, scene: Sequence[Shape], world_from_color: Floats) -> NDArray[np.bool_]:
    """[h, w] of the colour picture: what it sees there lies in the depth lens's picture, and nothing hides it."""
    lens, truth = camera.depth, look(scene, camera, world_from_color)
    assert lens is not None
    world_from_depth = world_from_color @ camera.color_from_depth
    offsets = truth.points - world_from_depth[:3, 3]
    nearest = np.min([shape(world_from_depth[:3, 3], offsets)[0] for shape in scene], axis=0)
    local = offsets @ world_from_depth[:3, :3]
    low, high = opencv_rays(lens)[2, 2, :2], opencv_rays(lens)[-3, -3, :2]
    slopes = local[..., :2] / local[..., 2:]
    inside = ((slopes > low) & (slopes < high)).all(-1)  # a barrel's corners reach farther out than its sides
    return (truth.depth_m > 0) & (nearest > 1 - 1e-9) & inside
