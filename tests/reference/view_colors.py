"""Float64 twin of view_colors.cl."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]


def view_colors(positions: Floats, colors: Floats, has_color: NDArray[np.bool_], voxel_m: float) -> Floats:
    """[n, 4]: the trilinear mean of the voxels with a colour, w = 1, or 0.

    positions [n, 3]; colors [z, y, x, 3]; has_color [z, y, x].
    """
    at = positions / voxel_m - 0.5
    low = np.floor(at)
    top = np.array(colors.shape[2::-1]) - 1
    total = np.zeros((len(positions), 4))
    for step in np.indices((2, 2, 2)).reshape(3, 8).T:
        weight = np.prod(1.0 - np.abs(low + step - at), axis=1)
        x, y, z = np.clip(low.astype(int) + step, 0, top).T
        known = has_color[z, y, x]
        total[:, :3] += (weight * known)[:, None] * colors[z, y, x]
        total[:, 3] += weight * known
    return np.where(
        total[:, 3:] > 0, np.column_stack([total[:, :3] / np.maximum(total[:, 3:], 1e-300), np.ones(len(total))]), 0.0
    )
