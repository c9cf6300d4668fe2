"""SSIM: how alike two pictures are in structure (Wang et al. 2004), a second opinion beside FLIP (E6)."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from skimage.metrics import structural_similarity

SIGMA_PX = 1.5
"""Of the Gaussian window, as published."""

Floats = NDArray[np.float64]


def ssim_map(reference: NDArray[np.uint8], test: NDArray[np.uint8]) -> Floats:
    """[h, w] similarity of each pixel's surroundings from -1 to 1 (alike), mean of the channels of sRGB codes
    [h, w, 3]. Raises ValueError for pictures of different sizes."""
    if reference.shape != test.shape:
        raise ValueError(f"the pictures have different sizes: {reference.shape} and {test.shape}")
    _, per_channel = structural_similarity(
        reference.astype(np.float64),
        test.astype(np.float64),
        data_range=255,
        channel_axis=-1,
        gaussian_weights=True,
        sigma=SIGMA_PX,
        use_sample_covariance=False,  # as published
        full=True,
    )
    found: Floats = per_channel.mean(axis=-1)
    return found
