"""Depth denoised by TV-L1, which the thesis names beside the bilateral filter (5.1.1); the program uses the latter."""

from __future__ import annotations

import numpy as np
import pyopencl.array as cl_array
from numpy.typing import NDArray

from server.input.denoise import tv_l1
from server.opencl.engine import Engine

_WEIGHT = 0.05
_CONTRAST_PER_M = 0.02
"""Of inverse depth. With this contrast and weight, 20 iterations smooth the steps of a structured-light sensor;
hundreds turn slopes into stairs."""
_EDGE_PER_M = 0.03
"""Inverse depths that differ by more are two surfaces: 3 cm at 1 m, 27 cm at 3 m."""
_ITERATIONS = 20


def tv_l1_depth(engine: Engine, depth_m: cl_array.Array) -> cl_array.Array:
    """Depth [h, w] metres, 0 = none, with its inverse denoised: the inverse depth of a plane is linear in the picture,
    and the noise of stereo and structured light is the same near and far. 0 stays 0.
    """
    inverse = engine.workspace.upload("test_inverse_depth", _inverted(engine.download(depth_m)))
    smooth = tv_l1(engine, inverse, _ITERATIONS, _WEIGHT, 0.0, contrast=_CONTRAST_PER_M, edge=_EDGE_PER_M)
    return engine.workspace.upload("test_smooth_depth", _inverted(engine.download(smooth)))


def _inverted(values: NDArray[np.float32]) -> NDArray[np.float32]:
    return np.divide(1, values, out=np.zeros_like(values), where=values > 0)
