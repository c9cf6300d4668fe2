"""A given light instead of an estimated one: from a file (`--light`) or a panorama (`--panorama`)."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from protocol.messages import Wishes
from server.light.light_estimation import LightEstimate
from server.maths.sh import rotate_sh


def static_estimate(wishes: Wishes, bands: int, webxr_from_world: NDArray[np.float64]) -> LightEstimate | None:
    """The light that `wishes` give, as [bands^2, 3] in world axes, exactly known; None where it is to be estimated.

    webxr_from_world: [3, 3], turns a light that is given in WebXR's axes into the world.
    """
    if wishes.light is None:
        return None
    given = np.array(wishes.light, np.float64)
    light = rotate_sh(given, webxr_from_world.T) if wishes.light_axes == "webxr" else given
    kept = np.zeros((bands * bands, 3))
    count = min(len(light), len(kept))
    kept[:count] = light[:count]
    return LightEstimate(sh=kept, std=np.zeros_like(kept), condition=1.0, valid=True)
