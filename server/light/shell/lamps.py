"""Bright parts of the shell as lights with a place and a size, which cast shadows; the rest stays soft.

A mode of the radiance above the shell's median, found by a mean shift over the shell, becomes one disc. Its window is
Gaussian, so that a lamp moves and grows with the evidence and does not jump between cells.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from server.maths.direct_lights import DirectLight, lamp_at
from server.maths.dominant import MOST_LIGHTS

WINDOW_M = 0.5
"""Standard deviation of the window: a ceiling panel or half a window."""
WEAK, STRONG = 0.05, 0.15
"""Shares of the radiance that arrives from the shell: a lamp below the first is none, one above the second is taken out
whole. Between them it fades in."""
LEAST_RADIUS_M = 0.05
_SHIFTS = 12

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class ShellLamp:
    """A disc on the shell."""

    center: Floats
    """[3] metres, world."""
    radius_m: float
    radiance: Floats
    """[3] above what is around it."""

    def as_direct_light(self, origin_world: Floats) -> DirectLight:
        """For the renderer; origin_world: [3] of the volume."""
        return lamp_at(self.center - origin_world, self.radius_m, self.radiance)


def find_lamps(position: Floats, ends: Floats, radiance: Floats) -> tuple[list[ShellLamp], Floats]:
    """At most MOST_LIGHTS lamps seen from `position` [3], and the radiance [m, 3] that they leave.

    ends: [m, 3] where evenly spread directions from there end on the shell; radiance: [m, 3].
    """
    rest = radiance.copy()
    floor = np.median(radiance, axis=0)
    total = float(radiance.sum())
    lamps: list[ShellLamp] = []
    for _ in range(MOST_LIGHTS):
        excess = np.maximum(rest - floor, 0.0)
        weights = excess.sum(axis=1)
        if weights.sum() <= WEAK * total:
            break
        center = _mode(ends, weights)
        near = np.exp(-((ends - center) ** 2).sum(axis=1) / (2 * WINDOW_M**2))
        share = float((near * weights).sum()) / total
        taken = near[:, None] * excess * np.clip((share - WEAK) / (STRONG - WEAK), 0.0, 1.0)
        if taken.sum() <= 0.0:
            break
        lamps.append(_disc(position, ends, taken))
        rest = rest - taken
    return lamps, rest


def _mode(ends: Floats, weights: Floats) -> Floats:
    """[3] where the weights are densest, from the strongest end."""
    center = ends[weights.argmax()]
    for _ in range(_SHIFTS):
        near = weights * np.exp(-((ends - center) ** 2).sum(axis=1) / (2 * WINDOW_M**2))
        center = near @ ends / near.sum()
    return np.asarray(center)


def _disc(position: Floats, ends: Floats, taken: Floats) -> ShellLamp:
    """The disc of the same centre, second moment and irradiance as the radiance `taken` [m, 3]."""
    weights = taken.sum(axis=1) / taken.sum()
    center = weights @ ends
    spread = float(weights @ ((ends - center) ** 2).sum(axis=1))
    radius_m = max(float(np.sqrt(2 * spread)), LEAST_RADIUS_M)
    distance_m = float(np.linalg.norm(center - position))
    irradiance = 4 * np.pi / len(ends) * taken.sum(axis=0)
    return ShellLamp(center, radius_m, irradiance * distance_m**2 / (np.pi * radius_m**2))
