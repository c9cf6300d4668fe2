"""Base colours: sRGB to linear."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

Linear = NDArray[np.float32]


def unit_range(values: NDArray[Any]) -> NDArray[np.float64]:
    """Integers of any width as fractions of their largest value; floats clipped to [0, 1], NaN as 0."""
    if np.issubdtype(values.dtype, np.integer):
        return values.astype(np.float64) / np.iinfo(values.dtype).max
    return np.clip(np.nan_to_num(values.astype(np.float64)), 0.0, 1.0)


def linear_from_srgb(values: NDArray[Any]) -> Linear:
    """IEC 61966-2-1 decoding of sRGB values in [0, 1]; any shape, float32 out."""
    srgb = np.asarray(values, np.float64)
    return np.where(srgb <= 0.04045, srgb / 12.92, ((srgb + 0.055) / 1.055) ** 2.4).astype(np.float32)
