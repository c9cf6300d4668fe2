"""How long what was found for the discs of the light stays true.

The light of a room is estimated every few frames, and its discs move by a degree or so each time: a small part of how
wide a lamp or window is seen. So they stay where virtual objects were drawn as they see them (shadow_map.py) until they
have moved noticeably. What real surface leaves of them is kept by place of the surface (trace_discs of shadow_map.cl)
and found anew with the place's radiance transfer, after 64 frames at most; before that only if discs have moved far.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence

import numpy as np

from server.maths.direct_lights import DirectLight

FAR = 0.2
"""How far a disc may move and grow, in its radii. Behind a straight edge, the part of a disc that is seen changes by at
most 2 / pi of this: 13 % of the light of the disc, in the penumbra of real things, with and without virtual ones."""
STEADY = 0.15
"""The same for where discs are drawn, 10 % of the light of a disc in the penumbra of virtual things. In the kitchen a
solution moves a disc by .06 in the median. Less than FAR: where discs move on, what is kept at most places still holds.
"""
_REMEMBERED = 80
"""Frames: more than a place's radiance transfer is kept for."""


class KeptDiscs:
    """The discs of the last frames."""

    def __init__(self) -> None:
        self._traced: deque[tuple[int, tuple[DirectLight, ...]]] = deque(maxlen=_REMEMBERED)

    def since(self, discs: Sequence[DirectLight], now: int) -> int:
        """The first of the frames up to `now` from which on all discs are nearly `discs`."""
        if self._traced and now < self._traced[-1][0]:
            self._traced.clear()
        first = now
        for number, traced in reversed(self._traced):
            if not are_near(traced, discs, FAR):
                break
            first = number
        self._traced.append((now, tuple(discs)))
        return first


def are_near(earlier: Sequence[DirectLight], discs: Sequence[DirectLight], most: float) -> bool:
    """Whether each disc has moved and grown by at most so much."""
    return len(earlier) == len(discs) and all(
        difference(before, disc) <= most for before, disc in zip(earlier, discs, strict=True)
    )


def difference(before: DirectLight, disc: DirectLight) -> float:
    """How far a disc has moved and by how much it has grown, in its radii; infinite where only one is distant."""
    if before.center_m is None or disc.center_m is None:
        if before.center_m is not disc.center_m:
            return np.inf
        turned = float(np.arccos(np.clip(before.direction @ disc.direction, -1.0, 1.0)))
        return (turned + abs(disc.half_angle_rad - before.half_angle_rad)) / before.half_angle_rad
    radius_m = _radius_m(before)
    return (float(np.linalg.norm(disc.center_m - before.center_m)) + abs(_radius_m(disc) - radius_m)) / radius_m


def _radius_m(disc: DirectLight) -> float:
    return disc.distance_m * float(np.tan(disc.half_angle_rad))
