"""Rounding of depth below the sensor's noise, so that it needs fewer bytes; off by default.

Stereo and structured light measure disparity, so their noise grows with the square of depth. Depth is therefore
rounded to equal steps of 1/depth, and then compressed without loss.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from numpy.typing import NDArray


def round_depth(depth: NDArray[np.uint16], noise_per_m: float, depth_scale_m: float) -> NDArray[np.uint16]:
    """[h, w] uint16 -> the same shape, each value changed by at most noise_per_m * z^2 metres. 0 (no depth) stays 0.

    `noise_per_m`: noise of the sensor at 1 m, in metres. `depth_scale_m`: metres per unit of depth.
    """
    return _table(noise_per_m, depth_scale_m)[depth]


@lru_cache(maxsize=8)
def _table(noise_per_m: float, depth_scale_m: float) -> NDArray[np.uint16]:
    """[65536] uint16: rounded value of each depth. Unchanged where one unit is coarser than the noise."""
    units = np.arange(65536)
    z = np.maximum(units, 1) * depth_scale_m
    step = 2 * noise_per_m  # in 1/m; half a step changes depth by noise_per_m * z^2
    levels = np.maximum(np.rint(1 / (z * step)), 1)
    rounded = np.rint(1 / (levels * step) / depth_scale_m)
    fits = np.abs(rounded - units) * depth_scale_m <= noise_per_m * z**2
    return np.where(fits & (units > 0) & (rounded >= 1) & (rounded <= 65535), rounded, units).astype(np.uint16)
