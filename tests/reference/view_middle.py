"""Twin of view_middle.cl: the middle of what a picture sees, float64."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray


def view_middle(
    positions: NDArray[np.float64], eye: NDArray[np.float64], step: int, share: float
) -> NDArray[np.float64] | None:
    """positions: [h, w, 4], w = 1 where there is surface; eye: [3], the camera. None without surface."""
    taken = positions[step // 2 :: step, step // 2 :: step].reshape(-1, 4)
    seen = taken[taken[:, 3] > 0, :3]
    return None if len(seen) == 0 else eye + share * (seen.mean(axis=0) - eye)
