"""Cheap facts about a frame, which decide the effects that it calls for."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from server.culling.influence_bound import NOWHERE, UNKNOWN, InfluenceBound, MostSent
from server.maths.microfacets import most_reflected
from server.maths.sh import LAMBERT_BANDS
from server.objects.rasterize import Placed
from server.shading.reflect import is_glossy
from server.shading.tone_mapping import Averages
from server.shading.traced_scene import DeviceLight
from server.transfer.sampling import Sampling

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Brightness:
    """The most radiance that there can be, in the picture's units and of its brightest channel; bounds, not means."""

    picture: float = math.inf
    """In the camera's picture."""
    arriving: float = math.inf
    """From any direction at any surface."""
    shading: float = math.inf
    """Of a white surface of any normal."""
    object_sent: float = math.inf
    """By objects."""
    real_sent: float = math.inf
    """By real surface to others."""


@dataclass(frozen=True)
class SceneFacts:
    """Facts about a frame."""

    objects: int
    objects_in_view: int
    has_light: bool
    adaptive: bool = False
    indirect: bool = False
    """Whether surfaces send light."""
    smooth_edges: bool = True
    image_space: bool = False
    """Whether visibility is looked up in depth pictures."""
    glossy: bool = False
    """Whether any virtual surface in view is not matt."""
    reflected: float = 1.0
    """Greatest share of what arrives that any of it reflects, or keeps from its diffuse light."""
    sharp_lights: int = 0
    """That shadow maps are for."""
    averages: Averages | None = None
    """Of the picture and its shading, None where they are not to be matched."""
    brightness: Brightness = field(default_factory=Brightness)
    reach: InfluenceBound = UNKNOWN
    """Of objects on real surface in view."""

    @property
    def returned(self) -> float:
        """The most radiance by which what real surface sends can change: all of it can be hidden."""
        change = min(self.reach.change, 1.0 + self.reach.sent)
        return change * self.brightness.real_sent if self.brightness.real_sent > 0 else 0.0

    @property
    def gain(self) -> float:
        """By which virtual surface is brighter than the light makes it."""
        return self.averages.gain if self.averages else 1.0


def gather_facts(
    objects: Sequence[Placed],
    boxes: Sequence[object],
    sampling: Sampling,
    smooth_edges: bool,
    light: DeviceLight,
    sh: Floats,
    rest: Floats,
    has_indirect: bool,
    picture_most: float,
    real_most: float,
    averages: Averages | None,
    measure: Callable[[MostSent], InfluenceBound],
) -> SceneFacts:
    """Facts of a frame. boxes: of boxes_in_view; sh, rest: radiance [bands^2, 3] of all of `light`, and less its
    discs, in the picture's units; picture_most, real_most: greatest radiance in the picture, and of real surface seen
    so far; measure: finds the reach of objects of which so much is sent."""
    in_view = [thing for (thing, _), box in zip(objects, boxes, strict=True) if box is not None]
    real = np.full(3, real_most) if has_indirect else np.zeros(3)
    around = np.maximum(real, light.unseen)
    arriving = np.maximum(most_radiance(sh), around)
    shading = most_shading(rest) + sum((disc.irradiance for disc in light.discs), np.zeros(3)) + SPREAD * around
    sent = shading * most_albedo(objects) if has_indirect else np.zeros(3)
    tables = [thing.tables.materials for thing in in_view]
    return SceneFacts(
        len(objects),
        len(in_view),
        has_light=bool(sh.any()),
        adaptive=sampling.adaptive,
        image_space=sampling.image_space,
        indirect=has_indirect,
        smooth_edges=smooth_edges,
        glossy=any(is_glossy(table) for table in tables),
        reflected=max((most_reflected(table, albedo=1.0) for table in tables), default=0.0),
        sharp_lights=len(light.discs),
        averages=averages,
        brightness=Brightness(
            picture_most, float(arriving.max()), float(shading.max()), float(sent.max()), float(real.max())
        ),
        reach=measure(MostSent(sent, real)) if objects and (arriving.any() or sent.any()) else NOWHERE,
    )


SPREAD = 1.1
"""Directions' shares of a surface's shading add up to 1, but for what error lattices of few directions have."""


def most_radiance(sh: Floats) -> Floats:
    """[3] no less than the radiance of `sh` [bands^2, 3] from any direction.

    By Cauchy and Schwarz, and as the sum over m of Y_lm^2 is (2 l + 1) / (4 pi): |L| is no more than the sum over l of
    |c_l| sqrt((2 l + 1) / (4 pi)).
    """
    return np.asarray(_band_sizes(sh).sum(axis=0))


def most_shading(sh: Floats) -> Floats:
    """[3] no less than the shading by `sh` [bands^2, 3] of an open white surface of any normal: as most_radiance."""
    sizes = _band_sizes(sh)
    return np.asarray(np.abs(LAMBERT_BANDS[: len(sizes)]) @ sizes)


def _band_sizes(sh: Floats) -> Floats:
    """[bands, 3]."""
    bands = math.isqrt(len(sh))
    sizes = [np.linalg.norm(sh[band**2 : (band + 1) ** 2], axis=0) for band in range(bands)]
    return np.array(sizes) * np.sqrt((2 * np.arange(bands)[:, None] + 1) / (4 * math.pi))


def most_albedo(objects: Sequence[Placed]) -> Floats:
    """[3] of the points that objects send from."""
    tops = [thing.surface_points.albedos.max(axis=0, initial=0.0) for thing, _ in objects]
    return np.asarray(np.max(tops, axis=0, initial=0.0)) if tops else np.zeros(3)
