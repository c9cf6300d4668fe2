"""Directional albedo of glossy surfaces: Karis' fit (2014) to the integral of GGX, as in reflect.cl."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

HEAD_ON = 0.04
"""Reflectance of dielectrics at normal incidence (F0)."""
_COSINES = np.linspace(0.0, 1.0, 65)


def reflected_share(roughness: Floats, cosine: Floats) -> tuple[Floats, Floats]:
    """(a, b) of the share a + b F0 of uniform light that microfacets reflect."""
    r = np.multiply.outer(roughness, (-1.0, -0.0275, -0.572, 0.022)) + np.array([1.0, 0.0425, 1.04, -0.04])
    a = np.minimum(r[..., 0] ** 2, np.exp2(-9.28 * cosine)) * r[..., 0] + r[..., 1]
    return 1.04 * a + r[..., 3], -1.04 * a + r[..., 2]


def most_reflected(materials: NDArray[np.float32], albedo: float) -> float:
    """Upper bound, over all directions, on the share of incident light that is reflected or missing from diffuse light.

    materials: rows as in MaterialTables; albedo: greatest base colour. 1 if a texture defines the surface.
    """
    if (materials[:, 3] >= 0).any():
        return 1.0
    roughness, metal = materials[:, None, 0].astype(np.float64), materials[:, None, 1].astype(np.float64)
    a, b = reflected_share(np.broadcast_to(roughness, (len(materials), len(_COSINES))), _COSINES)
    head_on = (1 - metal) * HEAD_ON + metal * albedo
    gloss = (a + b * head_on) * (1 + head_on * (1 / (a + b) - 1))
    kept = 1 - (1 - metal) * (1 - np.clip(a + HEAD_ON * b, 0, 1))
    return float(np.clip(np.maximum(gloss, kept), 0, 1).max())
