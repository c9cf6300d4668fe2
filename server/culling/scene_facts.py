"""Cheap facts about a frame, which decide the effects that it needs."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from server.culling.influence_bound import UNKNOWN, InfluenceBound
from server.maths.sh import LAMBERT_BANDS
from server.objects.rasterize import Placed

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Brightness:
    """Upper bounds on radiance, in the picture's units and of its brightest channel."""

    picture: float = math.inf
    """In the camera's picture."""
    arriving: float = math.inf
    """Arriving from any direction at any surface."""
    shading: float = math.inf
    """Shading of a white surface of any normal."""
    object_sent: float = math.inf
    """Sent by objects."""
    real_sent: float = math.inf
    """Sent by real surface to other surfaces."""


@dataclass(frozen=True)
class SceneFacts:
    """Facts about a frame."""

    objects_in_view: int
    adaptive: bool = False
    indirect: bool = False
    """Whether surfaces send light."""
    glossy: bool = False
    """Whether any virtual surface in view is not matt."""
    reflected: float = 1.0
    """Greatest share of arriving light that any virtual surface reflects, or loses from its diffuse light."""
    gain: float = 1.0
    """Factor on the shading of virtual surface."""
    brightness: Brightness = field(default_factory=Brightness)
    influence: InfluenceBound = UNKNOWN
    """Bound on the influence of objects on real surface in view."""

    @property
    def returned(self) -> float:
        """Bound on the change of the radiance that real surface sends: all of it can be blocked."""
        change = min(self.influence.change, 1.0 + self.influence.sent)
        return change * self.brightness.real_sent if self.brightness.real_sent > 0 else 0.0


SPREAD = 1.1
"""The weights of the directions of a surface's shading add up to 1, apart from the error of coarse lattices."""


def most_radiance(sh: Floats) -> Floats:
    """[3] upper bound on the radiance of `sh` [bands^2, 3] from any direction.

    By Cauchy and Schwarz, and as the sum over m of Y_lm^2 is (2 l + 1) / (4 pi): |L| is no more than the sum over l of
    |c_l| sqrt((2 l + 1) / (4 pi)).
    """
    return np.asarray(_band_sizes(sh).sum(axis=0))


def most_shading(sh: Floats) -> Floats:
    """[3] upper bound on the shading by `sh` [bands^2, 3] of an open white surface of any normal, as most_radiance."""
    sizes = _band_sizes(sh)
    return np.asarray(np.abs(LAMBERT_BANDS[: len(sizes)]) @ sizes)


def _band_sizes(sh: Floats) -> Floats:
    """[bands, 3]."""
    bands = math.isqrt(len(sh))
    sizes = [np.linalg.norm(sh[band**2 : (band + 1) ** 2], axis=0) for band in range(bands)]
    return np.array(sizes) * np.sqrt((2 * np.arange(bands)[:, None] + 1) / (4 * math.pi))


def most_albedo(objects: Sequence[Placed]) -> Floats:
    """[3] greatest values at the points that objects send from."""
    tops = [thing.surface_points.albedos.max(axis=0, initial=0.0) for thing, _ in objects]
    return np.asarray(np.max(tops, axis=0, initial=0.0)) if tops else np.zeros(3)
