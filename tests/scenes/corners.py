"""A corner of two white planes under a known light, of which a camera sees one; shading is summed over directions."""

from __future__ import annotations

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
FLOOR, WALL = 0, 1
"""The plane y = 0 with 0 < x < SIDE_M, and x = 0 with 0 < y < SIDE_M; both with |z| < HALF_M."""
WISHES = Wishes(volume_m=(-0.15, -0.15, -0.9, 1.3, 1.3, 0.9), voxel_m=0.02, preset="rm", up=(0, 1, 0), indirect="none")
_EVERY = 4  # of how many pixels one is shaded: shading is smooth
_DIRECTIONS = spherical_fibonacci(2048)


def view_of(part: int, shift_m: float = 0.0) -> Floats:
    """world_from_camera of a camera that faces one of the planes."""
    if part == FLOOR:
        return look_at((0.62 + shift_m, SIDE_M, 0.0), (0.62 + shift_m, 0.0, 1e-4), (1, 0, 0))
    return look_at((SIDE_M, 0.62 + shift_m, 0.0), (0.0, 0.62 + shift_m, 0.0), (0, 1, 0))


def corner_frame(part: int, index: int, light: Floats) -> RgbdFrame:
    """What that camera sees of its plane under `light` [16, 3], which the other one shadows."""
    pose = view_of(part, 0.01 * (index % 3))
    own, other = (1, 0) if part == FLOOR else (0, 1)
    rays = pixel_rays(CAMERA) @ pose[:3, :3].T
    points = pose[:3, 3] - pose[own, 3] / rays[..., own, None] * rays
    seen = (points[..., other] > 0.01) & (points[..., other] < SIDE_M) & (np.abs(points[..., 2]) < HALF_M)
    depth_m = (points - pose[:3, 3]) @ pose[:3, 2]
    shading = _shading(points[::_EVERY, ::_EVERY].reshape(-1, 3), own, other, light)
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


def _shading(points: Floats, own: int, other: int, light: Floats) -> Floats:
    """[n, 3] of white surface at `points` [n, 3] of the plane across axis `own`."""
    radiance = np.maximum(sh_basis(_DIRECTIONS, 4) @ light, 0.0)
    away = -points[:, None, other] / _DIRECTIONS[None, :, other]
    beside = points[:, None, 2] + away * _DIRECTIONS[None, :, 2]
    above = points[:, None, own] + away * _DIRECTIONS[None, :, own]
    hidden = (_DIRECTIONS[:, other] < 0) & (np.abs(beside) < HALF_M) & (above > 0) & (above < SIDE_M)
    return (~hidden * np.maximum(_DIRECTIONS[:, own], 0.0)) @ radiance * 4 / len(_DIRECTIONS)
