"""Screen-space bounds of boxes in space."""

from __future__ import annotations

from itertools import product

import numpy as np
from numpy.typing import NDArray

from protocol.frames import CameraModel
from server.objects.pinhole import Pinhole

NEAR_M = 0.05
"""Distance of the near plane."""
GUARD_PX = 1e6
"""Nothing that far out needs clipping; less than the bound in clip.clh, for rounding."""

Floats = NDArray[np.float64]
PixelBox = tuple[int, int, int, int]

_CORNERS = np.array(list(product((0.0, 1.0), repeat=3)))
_EDGES = np.array([(i, i | bit) for i in range(8) for bit in (1, 2, 4) if not i & bit])
"""Pairs of corners that differ in one axis."""


def pixel_boxes(
    camera: CameraModel | Pinhole, camera_from_model: Floats, low: Floats, high: Floats
) -> tuple[PixelBox | None, ...]:
    """For each model box `low` to `high` the bounds of its visible part in pixels; None if it is not in view.

    Matrices [n, 4, 4], corners [n, 3]. x0, y0, x1, y1, half-open, inside the picture.
    """
    if not len(low):
        return ()
    points, in_front = _in_front(_corners_in_camera(camera_from_model, low, high))
    depth = np.where(in_front, points[..., 2], 1.0)
    u, v = (points[..., k] / depth * f + c for k, f, c in ((0, camera.fx, camera.cx), (1, camera.fy, camera.cy)))
    x0, x1 = _span(u, in_front, camera.width)
    y0, y1 = _span(v, in_front, camera.height)
    seen = (x0 < x1) & (y0 < y1)
    rows = np.stack([x0, y0, x1, y1], axis=1).tolist()
    return tuple((a, b, c, d) if good else None for (a, b, c, d), good in zip(rows, seen.tolist(), strict=True))


def are_whole(camera: CameraModel | Pinhole, camera_from_model: Floats, low: Floats, high: Floats) -> bool:
    """Whether no triangle inside these boxes needs clipping (clip.clh). Arguments as of pixel_boxes."""
    if not len(low):
        return True
    x, y, depth = np.moveaxis(_corners_in_camera(camera_from_model, low, high), -1, 0)
    most = depth * GUARD_PX
    in_guard = (np.abs(x * camera.fx + depth * camera.cx) < most) & (np.abs(y * camera.fy + depth * camera.cy) < most)
    return bool((in_guard & (depth > 1.01 * NEAR_M)).all())


def _corners_in_camera(camera_from_model: Floats, low: Floats, high: Floats) -> Floats:
    corners = low[:, None] + _CORNERS * (high - low)[:, None]
    return corners @ camera_from_model[:, :3, :3].transpose(0, 2, 1) + camera_from_model[:, None, :3, 3]


def _span(places: Floats, valid: NDArray[np.bool_], size: int) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """First and last + 1 pixel of the valid `places` [n, m], cut to 0 to `size`; empty where none is valid."""
    low = np.where(valid, places, np.inf).min(axis=1)
    high = np.where(valid, places, -np.inf).max(axis=1)
    first = np.clip(np.floor(low), 0, size).astype(np.int64)
    return first, np.clip(np.ceil(high) + 1, 0, size).astype(np.int64)


def _in_front(corners: Floats) -> tuple[Floats, NDArray[np.bool_]]:
    """Corners of boxes [n, 8, 3] and where their edges pass the near plane [n, 20, 3], and which of them count."""
    beyond = corners[..., 2] >= NEAR_M
    start, end = _EDGES.T
    crossing = beyond[:, start] != beyond[:, end]
    a, b = corners[:, start], corners[:, end]
    rise = np.where(crossing, b[..., 2] - a[..., 2], 1.0)
    cuts = a + ((NEAR_M - a[..., 2]) / rise)[..., None] * (b - a)
    return np.concatenate([corners, cuts], axis=1), np.concatenate([beyond, crossing], axis=1)
