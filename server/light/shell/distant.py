"""The light from beyond the scan, from the lobes of the objective."""

from __future__ import annotations

import numpy as np

from server.light.light_estimation import LightEstimate
from server.light.place_light import VALID_SPREAD_DEG
from server.light.shell.solved import Solved
from server.light.shell.spread import deviations, spread_deg
from server.maths.lobes import LOBES, lobes_to_sh
from server.maths.sh import LUMINANCE


def distant_light(solved: Solved, bands: int) -> LightEstimate:
    """Of the first LOBES sources, whose covariance is known; no light before a first solve."""
    if solved.known == 0:
        return LightEstimate(np.zeros((bands * bands, 3)), None, float("inf"), valid=False)
    radiance, to_sh = solved.radiance[:LOBES], lobes_to_sh(bands)
    sh = to_sh @ radiance
    gradient = to_sh * (radiance @ LUMINANCE)  # by z, the logarithm
    covariance = solved.covariance_of(gradient)
    tint = sh[0] / max(float(sh[0] @ LUMINANCE), 1e-12)
    angle = spread_deg(sh @ LUMINANCE, covariance)
    std, is_valid = deviations(sh, covariance, tint), angle <= VALID_SPREAD_DEG
    return LightEstimate(sh, std, solved.condition, valid=is_valid, spread_deg=angle)
