"""How well one operating point finds a known light (E1, thesis 5.3.1, 6.1.3); pictures: client.tuning.known_light."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from client.tuning.known_light import LitFrame, estimated_lights
from protocol.frames import CameraModel
from protocol.messages import Wishes
from server.maths.light_direction import direction_dot, direction_error_deg
from server.opencl.device import Device
from tests.bench.light.environment import environment_difference

Floats = NDArray[np.float64]


@dataclass
class Score:
    """How well one operating point did, a figure a frame."""

    dots: list[float] = field(default_factory=list)
    """Dot product of dominant directions."""
    differences: list[float] = field(default_factory=list)
    """Of environment maps, relative."""
    lights: list[Floats] = field(default_factory=list)
    """[16, 3] as found."""


def score(device: Device, camera: CameraModel, frames: Iterable[LitFrame], wishes: Wishes) -> Score:
    """Run the pipeline over `frames`. Raises ValueError for wishes that it cannot fulfil."""
    result = Score()
    for item, found in estimated_lights(device, camera, frames, wishes):
        result.dots.append(direction_dot(found, item.sh))
        result.differences.append(environment_difference(found, item.sh))
        result.lights.append(found)
    return result


def lag_of(found: Sequence[Floats], true: Sequence[Floats], most: int) -> tuple[int, float]:
    """By how many frames, `most` at the most, estimates [16, 3] follow a moving light; the mean angle left, degrees.

    What is left at that lag is not lateness. Raises ValueError where there are not more than `most` frames.
    """
    frames = range(most, len(found))
    if not frames:
        raise ValueError(f"{len(found)} frames do not show a lag of {most}")
    angles = [
        float(np.mean([direction_error_deg(found[t], true[t - late]) for t in frames])) for late in range(most + 1)
    ]
    best = int(np.argmin(angles))
    return best, angles[best]
