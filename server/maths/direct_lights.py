"""Splits a spherical-harmonics light into discs, rendered with shadow maps, and a rest (thesis 7.2.3, fig. 7.7).

A light of b bands has no detail finer than about pi / b, so its shadows are soft even if it consists of small lights.
Dominant lights (dominant.py) that are smaller than b bands resolve are therefore taken out, each as a distant disc; the
remainder in the same bands is the rest. In these bands the lobes and the rest add up to the light exactly. The finest
band gives the size of a lobe: exp(-l (l + 1) spread^2 / 2) times the value of a point light.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cache, lru_cache
from math import inf, log, sqrt

import numpy as np
from numpy.typing import NDArray

from server.maths.directional_fit import directional_sh
from server.maths.dominant import DominantLight, dominant_lights
from server.maths.sh import sh_basis, spherical_fibonacci

SHARP, SOFT = 0.5, 0.3
"""Lobes with at least this share of their finest band are taken out completely, those with at most SOFT not at all; in
four bands: 19 and 26 degrees of spread."""
SHARPEST = 0.9
"""Upper limit on that share (8 degrees in four bands): narrower lobes cannot be distinguished from point lights."""
HALF_ANGLE = 1.75
"""Radius of a disc in standard deviations of the lobe. Two would give equal variance, but the tails are no light."""
LEAST_BANDS = 3
"""Two bands do not determine a spread."""
LEAST_GAIN = 0.005
"""See dominant_lights. If a third light is missed, two are too wide, and the rest becomes negative."""
LEAST_REST = 0.1
"""How negative the rest may become, in means of the light; negative parts of the light itself are allowed."""
_DIRECTIONS = 1024
_REMEMBERED = 8

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class DirectLight:
    """A disc of uniform radiance, which faces every point: distant, or at a place in the room."""

    direction: Floats
    """[3] unit, towards its centre, in the coefficients' axes."""
    irradiance: Floats
    """[3] RGB radiance of a white surface that faces it and receives no other light, as for a point light."""
    half_angle_rad: float
    center_m: Floats | None = None
    """[3] where its centre is, volume metres; None: it is distant."""
    distance_m: float = inf
    """Of a disc with a place: how far from `center_m` the other fields are as they say."""

    def seen_from(self, point_m: Floats) -> DirectLight:
        """The same light as it is at another point [3], volume metres, which must not be the disc's centre."""
        if self.center_m is None:
            return self
        offset = self.center_m - point_m
        distance_m = float(np.linalg.norm(offset))
        nearer = self.distance_m / distance_m
        angle = float(np.arctan(nearer * np.tan(self.half_angle_rad)))
        return replace(
            self,
            direction=offset / distance_m,
            irradiance=nearer**2 * self.irradiance,
            half_angle_rad=angle,
            distance_m=distance_m,
        )


def lamp_at(center_m: Floats, radius_m: float, radiance: Floats) -> DirectLight:
    """A disc of `radius_m` and RGB `radiance` [3] at `center_m` [3], volume metres."""
    # Irradiance over pi of a far disc is its radiance times its solid angle over pi, here at a metre.
    return DirectLight(
        direction=np.array([0.0, -1.0, 0.0]),
        irradiance=radius_m**2 * np.asarray(radiance, np.float64),
        half_angle_rad=float(np.arctan(radius_m)),
        center_m=np.asarray(center_m, np.float64),
        distance_m=1.0,
    )


@dataclass(frozen=True)
class SplitLight:
    """A light as discs and a rest."""

    rest: Floats
    """[..., bands^2, 3] radiance coefficients of the rest, as of the light."""
    discs: tuple[DirectLight, ...]
    """Strongest first."""


def split_light(coefficients: Floats) -> SplitLight:
    """The discs in a light of radiance `coefficients` [bands^2, 3], and the rest; no discs where it is soft."""
    return _split(np.ascontiguousarray(coefficients, np.float64).tobytes())


@lru_cache(_REMEMBERED)  # a given light is the same in every frame
def _split(raw: bytes) -> SplitLight:
    light = np.frombuffer(raw, np.float64).reshape(-1, 3)
    bands = round(sqrt(len(light)))
    if bands < LEAST_BANDS:
        return SplitLight(light, ())
    shares = [(lobe, _share(lobe, bands)) for lobe in dominant_lights(light, least_gain=LEAST_GAIN)]
    taken = [(lobe, share) for lobe, share in shares if share > 0]
    out = sum((_lobe(lobe, share, bands) for lobe, share in taken), np.zeros_like(light))
    amount = _most_of(light, out, bands)
    if amount == 0 or not taken:
        return SplitLight(light, ())
    discs = (
        DirectLight(lobe.direction, amount * share * lobe.irradiance, _half_angle(lobe, bands)) for lobe, share in taken
    )
    return SplitLight(light - amount * out, tuple(discs))


def _share(lobe: DominantLight, bands: int) -> float:
    """Share of a lobe that is taken out; continuous, so that discs do not pop as the estimate changes."""
    finest = bands * (bands - 1) / 2
    return float(np.clip((np.exp(-finest * lobe.spread_rad**2) - SOFT) / (SHARP - SOFT), 0.0, 1.0))


def _lobe(lobe: DominantLight, share: float, bands: int) -> Floats:
    """[bands^2, 3]."""
    return np.outer(share * directional_sh(lobe.direction, lobe.spread_rad, bands), lobe.irradiance)


def _half_angle(lobe: DominantLight, bands: int) -> float:
    return HALF_ANGLE * max(lobe.spread_rad, sqrt(-log(SHARPEST) / (bands * (bands - 1) / 2)))


@cache
def _basis(bands: int) -> Floats:
    """[_DIRECTIONS, bands^2]."""
    return sh_basis(spherical_fibonacci(_DIRECTIONS), bands)


def _most_of(light: Floats, out: Floats, bands: int) -> float:
    """Largest share of `out`, at most 1, that can be taken from `light` without making the rest too negative."""
    basis = _basis(bands)
    arriving, taken = basis @ light, basis @ out
    allowed = np.maximum(LEAST_REST * arriving.mean(axis=0), -arriving.min(axis=0))
    return float(np.clip(np.min((arriving + allowed)[taken > 0] / taken[taken > 0], initial=1.0), 0.0, 1.0))
