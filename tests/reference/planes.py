"""Float64 twin of how far planes must go on to be met (server/maths/planes.py)."""

from __future__ import annotations

import numpy as np

from server.maths.planes import CELL_M, PlanePatch
from tests.analytic import Floats


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
