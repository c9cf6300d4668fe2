"""SSIM: how alike two pictures are in structure (Wang et al. 2004), a second opinion beside FLIP (E6)."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

SIGMA_PX = 1.5
"""Of the Gaussian window, as published."""
_C1, _C2 = (0.01 * 255) ** 2, (0.03 * 255) ** 2

Floats = NDArray[np.float64]


def ssim_map(reference: NDArray[np.uint8], test: NDArray[np.uint8]) -> Floats:
    """[h, w] similarity of each pixel's surroundings from -1 to 1 (alike), mean of the channels of sRGB codes
    [h, w, 3]. Raises ValueError for pictures of different sizes."""
    if reference.shape != test.shape:
        raise ValueError(f"the pictures have different sizes: {reference.shape} and {test.shape}")
    a, b = reference.astype(np.float64), test.astype(np.float64)
    mean_a, mean_b = _blurred(a), _blurred(b)
    var_a, var_b = _blurred(a * a) - mean_a**2, _blurred(b * b) - mean_b**2
    both = _blurred(a * b) - mean_a * mean_b
    brightness = (2 * mean_a * mean_b + _C1) / (mean_a**2 + mean_b**2 + _C1)
    structure = (2 * both + _C2) / (var_a + var_b + _C2)
    found: Floats = (brightness * structure).mean(axis=-1)
    return found


def _blurred(picture: Floats) -> Floats:
    return np.asarray(cv2.GaussianBlur(picture, (11, 11), SIGMA_PX, borderType=cv2.BORDER_REFLECT), np.float64)
