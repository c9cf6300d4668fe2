"""How far a light's dominant direction may be off, from the curvature of the objective."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

SPREAD_DOUBT, LEAST_SPREAD_DEG = 2.0, 12.0
"""Standard deviations over what the curvature tells of them, and the angle that a cell's size leaves unknown: so that
90 % of directions are within the spread in each of the rooms r1, r3 and r4 (docs/light.md)."""
_QUANTILE_90 = 2.146  # radius that holds 90 % of a two-dimensional normal distribution
_LINEAR = [3, 1, 2]  # x, y, z

Floats = NDArray[np.float64]


def deviations(covariance: Floats) -> Floats:
    """[n] standard deviations, for what the curvature tells of n coefficients, [n, n]."""
    return np.asarray(SPREAD_DOUBT * np.sqrt(np.maximum(np.diag(covariance), 0.0)))


def spread_deg(sh: Floats, covariance: Floats) -> float:
    """Angle that 90 % of dominant directions are within, for luminance [n] as harmonics and its covariance [n, n]."""
    vector, spread = sh[_LINEAR], covariance[np.ix_(_LINEAR, _LINEAR)]
    length = float(np.linalg.norm(vector))
    if length < 1e-12:
        return 180.0
    across = np.linalg.svd(np.eye(3) - np.outer(vector, vector) / length**2)[0][:, :2]
    deviation = np.sqrt(max(float(np.trace(across.T @ spread @ across)) / 2, 0.0))
    angle = np.degrees(np.arctan2(SPREAD_DOUBT * _QUANTILE_90 * deviation, length))
    return float(np.hypot(angle, LEAST_SPREAD_DEG))
