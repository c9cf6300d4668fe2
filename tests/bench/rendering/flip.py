"""FLIP: how different two pictures look to someone who flips between them (thesis E6's place for HDR-VDP-2).

The metric is NVIDIA's own implementation of Andersson et al., "FLIP: A Difference Evaluator for Alternating Images"
(2020), `flip_evaluator`, which the tests install.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

PIXELS_PER_DEGREE = 67.0
"""The metric's default: a 0.7 m wide display of 3840 pixels seen from 0.7 m."""

Codes = NDArray[np.uint8]


def flip_map(reference: Codes, test: Codes) -> NDArray[np.float64]:
    """[h, w] error of each pixel from 0 (looks the same) to 1, of two pictures [h, w, 3] of sRGB codes.

    Raises ImportError where flip_evaluator is not installed, ValueError for pictures of different sizes.
    """
    from flip_evaluator import evaluate

    if reference.shape != test.shape:
        raise ValueError(f"the pictures have different sizes: {reference.shape} and {test.shape}")
    pictures = (np.ascontiguousarray(codes, np.float32) / np.float32(255) for codes in (reference, test))
    error, _mean, _parameters = evaluate(*pictures, "LDR", applyMagma=False, parameters={"ppd": PIXELS_PER_DEGREE})
    found: NDArray[np.float64] = np.asarray(error, np.float64).reshape(reference.shape[:2])
    return found
