"""Base colours: sRGB to linear, and a texture read at vertices."""

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


_LINEAR_FROM_BYTE = linear_from_srgb(np.arange(256) / 255.0)


def sample_texture(image: NDArray[np.uint8], uv: NDArray[np.float64]) -> Linear:
    """Bilinear, in linear light, repeating. `image` [h, w, 3] sRGB; `uv` [n, 2], (0, 0) is the top left corner.

    Coordinates that are not finite read as 0. Returns [n, 3] linear.
    """
    height, width = image.shape[:2]
    at = np.mod(np.where(np.isfinite(uv), uv, 0.0), 1.0) * (width, height) - 0.5
    low = np.floor(at).astype(np.int64)
    high_share = (at - low).astype(np.float32)
    total = np.zeros((len(uv), 3), np.float32)
    for dx in (0, 1):
        for dy in (0, 1):
            share = np.abs(1 - dx - high_share[:, 0]) * np.abs(1 - dy - high_share[:, 1])
            texel = image[(low[:, 1] + dy) % height, (low[:, 0] + dx) % width]
            total += share[:, None] * _LINEAR_FROM_BYTE[texel]
    return total
