"""The light from beyond the scan, from the lobes of the objective."""

from __future__ import annotations

import numpy as np

from server.light.light_estimation import LightEstimate
from server.light.place_light import VALID_SPREAD_DEG
from server.light.shell.objective import Unknowns
from server.light.shell.spread import deviations, spread_deg
from server.maths.lobes import LOBES, lobes_to_sh
from server.maths.sh import LUMINANCE


def distant_light(unknowns: Unknowns, bands: int) -> LightEstimate:
    """Of the first LOBES sources; no light before a first solve."""
    if unknowns.known == 0:
        return LightEstimate(np.zeros((bands * bands, 3)), None, float("inf"), valid=False)
    radiance, to_sh = unknowns.radiance[:LOBES], lobes_to_sh(bands)
    sh = to_sh @ radiance
    gradient = to_sh * (radiance @ LUMINANCE)  # by z, the logarithm
    covariance, condition = unknowns.covariance_of(gradient)
    tint = sh[0] / max(float(sh[0] @ LUMINANCE), 1e-12)
    angle = spread_deg(sh @ LUMINANCE, covariance)
    return LightEstimate(
        sh, np.outer(deviations(covariance), tint), condition, valid=angle <= VALID_SPREAD_DEG, spread_deg=angle
    )
