"""A corner of two or three white planes under a known light, of which a camera sees one.

Shading is summed over directions.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence

import cv2
import numpy as np
from numpy.typing import ArrayLike

from protocol.frames import CameraModel, RgbdFrame
from protocol.messages import Wishes
from server.maths.sh import sh_basis, spherical_fibonacci
from tests.scenes.analytic import Floats, look_at, pixel_rays

CAMERA = CameraModel(
    width=128, height=96, fx=100.0, fy=100.0, cx=63.5, cy=47.5, depth_scale_m=0.0002, color_encoding="linear16"
)
SIDE_M, HALF_M, ALBEDO = 1.2, 0.8, 0.5
FLOOR, WALL, END = 0, 1, 2
"""The planes y = 0 with 0 < x < SIDE_M, x = 0 with 0 < y < SIDE_M, both with |z| < HALF_M, and z = -HALF_M between."""
_AXES = (1, 0, 2)
"""Which axis each is across."""
_LOW, _HIGH = np.array([0.0, 0.0, -HALF_M]), np.array([SIDE_M, SIDE_M, HALF_M])
WISHES = Wishes(volume_m=(-0.15, -0.15, -0.9, 1.3, 1.3, 0.9), voxel_m=0.02, preset="rm", up=(0, 1, 0), indirect="none")
_EVERY = 4  # of how many pixels one is shaded: shading is smooth
_DIRECTIONS = spherical_fibonacci(2048)


def view_of(part: int, shift_m: float = 0.0) -> Floats:
    """world_from_camera of a camera that faces one of the planes."""
    if part == FLOOR:
        return look_at((0.62 + shift_m, SIDE_M, 0.0), (0.62 + shift_m, 0.0, 1e-4), (1, 0, 0))
    if part == WALL:
        return look_at((SIDE_M, 0.62 + shift_m, 0.0), (0.0, 0.62 + shift_m, 0.0), (0, 1, 0))
    return look_at((0.62 + shift_m, 0.62, SIDE_M - HALF_M), (0.62 + shift_m, 0.62, -HALF_M), (0, 1, 0))


def corner_frame(part: int, index: int, light: Floats, planes: Collection[int] = (FLOOR, WALL)) -> RgbdFrame:
    """What that camera sees of its plane under `light` [16, 3], which the others of `planes` shadow."""
    pose = view_of(part, 0.01 * (index % 3))
    own = _AXES[part]
    rays = pixel_rays(CAMERA) @ pose[:3, :3].T
    points = pose[:3, 3] - (pose[own, 3] - _LOW[own]) / rays[..., own, None] * rays
    inside = (points > _LOW + 0.01 * (np.array([0, 1, 2]) < 2)) & (points < _HIGH)
    seen = inside[..., [axis for axis in range(3) if axis != own]].all(axis=-1)
    depth_m = (points - pose[:3, 3]) @ pose[:3, 2]
    others = [_AXES[plane] for plane in planes if plane != part]
    shading = _shading(points[::_EVERY, ::_EVERY].reshape(-1, 3), own, others, light)
    small = shading.reshape(CAMERA.height // _EVERY, -1, 3).astype(np.float32)
    whole = cv2.resize(small, (CAMERA.width, CAMERA.height), interpolation=cv2.INTER_LINEAR)
    color = np.where(seen[..., None], np.clip(ALBEDO * whole * 65535, 0, 65535), 0).astype(np.uint16)
    units = np.where(seen, np.rint(depth_m / CAMERA.depth_scale_m), 0).astype(np.uint16)
    return RgbdFrame(index, index / 30, color, units, pose)


def degrees_across(direction: ArrayLike, towards: ArrayLike) -> float:
    """Angle between two directions as seen along the edge: about the third axis, which no surface faces, two planes
    tell next to nothing."""
    (x, y), (to_x, to_y) = np.asarray(direction)[:2], np.asarray(towards)[:2]
    return float(np.degrees(np.abs(np.arctan2(x * to_y - y * to_x, x * to_x + y * to_y))))


def _shading(points: Floats, own: int, others: Sequence[int], light: Floats) -> Floats:
    """[n, 3] of white surface at `points` [n, 3] of the plane across axis `own`, beside the planes across `others`."""
    radiance = np.maximum(sh_basis(_DIRECTIONS, 4) @ light, 0.0)
    open_ = np.ones((len(points), len(_DIRECTIONS)), bool)
    for other in others:
        away = (_LOW[other] - points[:, None, other]) / _DIRECTIONS[None, :, other]
        ends = points[:, None] + away[..., None] * _DIRECTIONS
        along = [axis for axis in range(3) if axis != other]
        met = ((ends > _LOW) & (ends < _HIGH))[..., along].all(axis=-1)
        open_ &= ~((_DIRECTIONS[:, other] < 0) & met)
    return (open_ * np.maximum(_DIRECTIONS[:, own], 0.0)) @ radiance * 4 / len(_DIRECTIONS)
