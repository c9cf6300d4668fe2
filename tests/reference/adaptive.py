"""Float64 twin of cl_kernels/adaptive.cl."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]


def edges(positions: Floats, normals: Floats, tolerance_m: float) -> NDArray[np.bool_]:
    """[h, w] covered pixels beside one that is not covered, faces 25 degrees elsewhere or is off the tangent plane.

    positions, normals [h, w, 4], w = 1 where covered.
    """
    height, width = positions.shape[:2]
    found = np.zeros((height, width), bool)
    for y, x in np.argwhere(positions[..., 3] > 0):
        for v, u in ((y, x - 1), (y, x + 1), (y - 1, x), (y + 1, x)):
            if not (0 <= v < height and 0 <= u < width):
                continue
            offset = positions[v, u, :3] - positions[y, x, :3]
            flat = abs(offset @ normals[y, x, :3]) < tolerance_m + 0.3 * np.linalg.norm(offset)
            same = positions[v, u, 3] > 0 and normals[v, u, :3] @ normals[y, x, :3] > 0.9
            found[y, x] |= not (flat and same)
    return found


def varying(ratio: Floats, least_change: float) -> tuple[NDArray[np.bool_], Floats]:
    """[rows + 1, cols + 1] whether the means of 4 x 4 samples to opposite sides of a cell differ by more than
    `least_change`, and by how much more. ratio [rows, cols, 4]; cell (i, j) begins at sample (i - 1, j - 1).
    """
    rows, cols = ratio.shape[:2]

    def mean(row: int, col: int) -> Floats | None:
        block = ratio[max(row, 0) : max(row + 4, 0), max(col, 0) : max(col + 4, 0)]
        used = block[block[..., 3] > 0]
        return used[:, :3].mean(0) if len(used) else None

    def change(one: Floats | None, other: Floats | None) -> float:
        return 0.0 if one is None or other is None else float(np.abs(one - other).max())

    found = np.zeros((rows + 1, cols + 1))
    for i, j in np.ndindex(found.shape):
        across = change(mean(i - 2, j - 4), mean(i - 2, j))
        along = change(mean(i - 4, j - 2), mean(i, j - 2))
        found[i, j] = max(across, along)
    return found > least_change, found - least_change
