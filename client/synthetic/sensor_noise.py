"""Noise of a structured-light depth sensor: lateral jitter, disparity steps, drop-outs at grazing angles."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

JITTER_PX = 0.5
DISPARITY_NOISE_PX = 0.06
DISPARITY_STEP_PX = 1 / 8
BASELINE_M = 0.075
DROPOUT_FROM_COSINE, DROPOUT_ALWAYS_COSINE = 0.35, 0.1
"""Below the first cosine of incidence some pixels are lost, below the second all."""
SEED = 20150923


def kinect_like(depth_m: Floats, cosines: Floats, focal_px: float, index: int) -> Floats:
    """[h, w] noisy depth in metres (0: none) from exact depth and the cosine between normal and ray.

    Deterministic for each frame `index`.
    """
    random = np.random.default_rng([SEED, index])
    height, width = depth_m.shape
    shifted = (
        np.clip(np.indices(depth_m.shape) + random.normal(0, JITTER_PX, (2, height, width)), 0, None)
        .round()
        .astype(int)
    )
    rows, columns = np.minimum(shifted[0], height - 1), np.minimum(shifted[1], width - 1)
    seen, slant = depth_m[rows, columns], cosines[rows, columns]
    scale = focal_px * BASELINE_M
    disparity = scale / np.where(seen > 0, seen, 1) + random.normal(0, DISPARITY_NOISE_PX, seen.shape)
    disparity = (disparity / DISPARITY_STEP_PX).round() * DISPARITY_STEP_PX
    chance = (DROPOUT_FROM_COSINE - slant) / (DROPOUT_FROM_COSINE - DROPOUT_ALWAYS_COSINE)
    lost = (seen == 0) | (disparity <= 0) | (random.random(seen.shape) < chance)
    return np.where(lost, 0, scale / np.where(lost, 1, disparity))
