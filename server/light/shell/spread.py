"""How far a light's dominant direction may be off, from the curvature of the objective."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

SPREAD_DOUBT, LEAST_SPREAD_DEG = 2.0, 12.0
"""Standard deviations over what the curvature tells of them, and the angle that a cell's size leaves unknown: so that
90 % of directions are within the spread in each of the rooms r1, r3 and r4 (docs/light_experiments.md)."""
_QUANTILE_90 = 2.146  # radius that holds 90 % of a two-dimensional normal distribution
_LINEAR = [3, 1, 2]  # x, y, z

Floats = NDArray[np.float64]


def deviations(sh: Floats, covariance: Floats, tint: Floats) -> Floats:
    """[n, 3] standard deviations of radiance `sh` [n, 3] as harmonics, by the covariance [n, n] of their luminance.

    tint: [3] colour of what is not known, of luminance 1. Besides, all of the light may be turned by LEAST_SPREAD_DEG:
    about random axes that changes the coefficients of band l by their length times sqrt(l (l + 1)), all alike.
    """
    told = SPREAD_DOUBT * np.outer(np.sqrt(np.maximum(np.diag(covariance), 0.0)), tint)
    bands = np.repeat(np.arange(count := math.isqrt(len(sh))), 2 * np.arange(count) + 1)
    lengths = np.sqrt(np.add.reduceat(sh**2, np.arange(count) ** 2))[bands]
    turn = np.radians(LEAST_SPREAD_DEG) / _QUANTILE_90
    turned = turn * np.sqrt(bands * (bands + 1) / (2 * bands + 1))[:, None] * lengths
    return np.asarray(np.hypot(told, turned))


def spread_deg(sh: Floats, covariance: Floats) -> float:
    """Angle that 90 % of dominant directions are within, for luminance [n] as harmonics and its covariance [n, n]."""
    vector, spread = sh[_LINEAR], covariance[np.ix_(_LINEAR, _LINEAR)]
    length = float(np.linalg.norm(vector))
    if length < 1e-12:
        return 180.0
    across = float(np.trace(spread) - vector @ spread @ vector / length**2)
    deviation = np.sqrt(max(across / 2, 0.0))
    angle = np.degrees(np.arctan2(SPREAD_DOUBT * _QUANTILE_90 * deviation, length))
    return float(np.hypot(angle, LEAST_SPREAD_DEG))
