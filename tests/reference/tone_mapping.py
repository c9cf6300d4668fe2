"""Float64 twin of cl_kernels/tone_mapping.cl (thesis 7.1, H)."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
LUMINANCE = np.array([0.2126, 0.7152, 0.0722])  # Rec. 709


def averages(
    radiance: Floats,
    has_surface: NDArray[np.bool_],
    transfer: Floats,
    openness: Floats,
    hits: Floats,
    light: Floats,
    unseen: Floats,
    surface_gain: float,
    rays: int,
    every: int,
) -> tuple[float, float, int]:
    """Mean luminance of the picture, of R, and the number of samples, over every `every`-th one along both axes.

    Per sample: radiance [rows, cols, 4] (w = 1 usable), has_surface, transfer [rows, cols, n], openness, hits [rows,
    cols, 4] as of indirect.cl. light [n, 3]; unseen [3]: what surface that no picture shows sends.
    """
    pairs = []
    for row in range(0, openness.shape[0], every):
        for col in range(0, openness.shape[1], every):
            if radiance[row, col, 3] <= 0 or not has_surface[row, col] or openness[row, col] < 0:
                continue
            hidden, hit = 1 - openness[row, col], hits[row, col]
            known = min(hit[3] / max(rays / 4 * hidden, 1e-6), 1.0)
            sent = (1 - known) * unseen
            if hit[3] > 0:
                sent = sent + known * surface_gain * hit[:3] / hit[3]
            shaded = np.maximum(transfer[row, col] @ light + hidden * sent, 0)
            pairs.append((radiance[row, col, :3] @ LUMINANCE, shaded @ LUMINANCE))
    if not pairs:
        return 0.0, 0.0, 0
    picture, shading = np.mean(pairs, axis=0)
    return float(picture), float(shading), len(pairs)
