"""Float64 twins of how far planes must go on to be met (server/maths/planes.py), and of what a camera looked through
(server/light/continuation.py)."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from protocol.frames import CameraModel
from server.maths.planes import CELL_M, PlanePatch
from tests.scenes.analytic import Floats


def beyond(plane: PlanePatch, origins: Floats, directions: Floats, least_m: float) -> list[Floats]:
    """For each side [n, m] how far beyond it rays from `origins` [n, 3] along `directions` [m, 3] meet the plane,
    metres; inf where they do not, or where a camera looked through."""
    sinking = directions @ plane.normal
    with np.errstate(divide="ignore"):
        t = (plane.offset_m - origins @ plane.normal)[:, None] / np.where(np.abs(sinking) < 1e-5, np.inf, sinking)
    x = (origins @ plane.across - plane.corner[0])[:, None] + t * (directions @ plane.across)
    y = (origins @ plane.along - plane.corner[1])[:, None] + t * (directions @ plane.along)
    rows, cols = plane.empty.shape
    col = np.clip(np.nan_to_num(x / CELL_M), 0, cols - 1).astype(np.int64)
    row = np.clip(np.nan_to_num(y / CELL_M), 0, rows - 1).astype(np.int64)
    (low_x, low_y), (high_x, high_y) = plane.seen
    misses = (t < least_m) | plane.empty[row, col]
    over = (low_x - x, x - high_x, low_y - y, y - high_y)
    return [np.where(misses, np.inf, np.maximum(side, 0.0)) for side in over]


def looked_through(
    plane: PlanePatch, camera: CameraModel, camera_from_volume: Floats, depth_m: Floats, least_m: float, apart_m: float
) -> NDArray[np.bool_]:
    """[rows, cols] cells of the plane's map, farther than `least_m`, in whose pixel something was measured more than
    `apart_m` behind them. depth_m: [h, w], 0 = none."""
    at = plane.cell_centers() @ camera_from_volume[:3, :3].T + camera_from_volume[:3, 3]
    through = np.zeros(at.shape[:2], np.bool_)
    for cell in np.ndindex(*through.shape):
        x, y, z = at[cell]
        if z <= least_m:
            continue
        u, v = round(x / z * camera.fx + camera.cx), round(y / z * camera.fy + camera.cy)
        if 0 <= u < camera.width and 0 <= v < camera.height:
            through[cell] = depth_m[v, u] > z + apart_m
    return through
