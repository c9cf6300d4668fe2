"""The middle of what a picture sees: the place for which a frame's light is told. Kernel: view_middle.cl."""

from __future__ import annotations

import numpy as np
import pyopencl.cltypes as cl_types
from numpy.typing import NDArray

from server.opencl.engine import Engine
from server.volume.raycast import Surface

STEP_PX = 4
"""Every so many pixels along both axes: 19200 points of 640x480 fix their mean far better than a voxel."""
SHARE = 0.9
"""Of the way from the camera to the mean of the surface. The mean lies on a wall that fills the picture; a tenth of the
way in front of it is free."""


class ViewMiddle:
    """Of one picture; begun when this is made."""

    def __init__(self, engine: Engine, surface: Surface) -> None:
        height, width = surface.positions.shape
        rows = len(range(STEP_PX // 2, height, STEP_PX))
        sums = engine.array_to_read((rows,), cl_types.float4)
        kernel = engine.kernel("view_middle.cl", "sum_positions")
        engine.launch(kernel, (rows,), width, rows, STEP_PX, surface.positions, sums)
        self._sums = engine.begin_download(sums)

    def seen_from(self, eye: NDArray[np.float64]) -> NDArray[np.float64] | None:
        """[3] volume metres: SHARE of the way from `eye` [3] to the mean of the seen surface; None if there is none."""
        total = self._sums.result().view(np.float32).reshape(-1, 4).astype(np.float64).sum(axis=0)
        if total[3] == 0:
            return None
        return np.asarray(eye + SHARE * (total[:3] / total[3] - eye))
