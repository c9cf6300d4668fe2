"""Depth rounded below a sensor's own noise, so that it takes fewer bytes; exact unless somebody asks for it.

Of stereo and structured light the noise grows with the square of depth, for disparity is what they measure. Depth is
rounded to equal steps of 1/depth, which have that very spacing, and then goes through the same lossless codec.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from numpy.typing import NDArray


def round_depth(depth: NDArray[np.uint16], noise_per_m: float, depth_scale_m: float) -> NDArray[np.uint16]:
    """[h, w] uint16, 0 = none -> the same, each moved by no more than noise_per_m * z^2 metres. 0 stays 0.

    `noise_per_m`: of the sensor at 1 m, in metres. `depth_scale_m`: metres per unit of depth.
    """
    return _table(noise_per_m, depth_scale_m)[depth]


@lru_cache(maxsize=8)
def _table(noise_per_m: float, depth_scale_m: float) -> NDArray[np.uint16]:
    """[65536] uint16: what each value becomes. Where whole units are coarser than the noise it stays what it is."""
    units = np.arange(65536)
    z = np.maximum(units, 1) * depth_scale_m
    step = 2 * noise_per_m  # in 1/m: half of it is noise_per_m * z^2 of depth
    levels = np.maximum(np.rint(1 / (z * step)), 1)
    rounded = np.rint(1 / (levels * step) / depth_scale_m)
    fits = np.abs(rounded - units) * depth_scale_m <= noise_per_m * z**2
    return np.where(fits & (units > 0) & (rounded >= 1) & (rounded <= 65535), rounded, units).astype(np.uint16)
