"""Lights that are drawn with shadow maps, taken out of a spherical-harmonics light (thesis 7.2.3, fig. 7.7).

A light of b bands shows no edge sharper than about pi / b: rays that bring it throw soft shadows even where it is made
of small lights. Its dominant lights (dominant.py) that are smaller than b bands can show are therefore taken out of it,
each a far disc; what is left, in the same bands, is the rest. In these bands the lobes and the rest add up to the light
exactly. How small a lobe is, its finest band says: exp(-l (l + 1) spread^2 / 2) of what a point would have there.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache, lru_cache
from math import log, sqrt

import numpy as np
from numpy.typing import NDArray

from server.maths.directional_fit import directional_sh
from server.maths.dominant import DominantLight, dominant_lights
from server.maths.sh import sh_basis, spherical_fibonacci

SHARP, SOFT = 0.5, 0.3
"""Lobes that keep as much of their finest band are taken out whole, those that keep no more than SOFT not at all; four
bands: 19 and 26 degrees of spread."""
SHARPEST = 0.9
"""Lobes that keep more are taken to keep so much (8 degrees in four bands): no estimate tells them from points."""
HALF_ANGLE = 1.75
"""Of a disc, in the lobe's standard deviations. Two have the same variance, but the lobe's tails are no light's."""
LEAST_BANDS = 3
"""Two tell no spread."""
LEAST_GAIN = 0.005
"""See dominant_lights. Where a third light is missed, two are too wide, and the rest goes below zero."""
LEAST_REST = 0.1
"""How far below zero the rest may go, in means of the light; what the light goes below by itself is let."""
_DIRECTIONS = 1024
_REMEMBERED = 8

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class DirectLight:
    """A far disc of even radiance."""

    direction: Floats
    """[3] unit, towards its middle, in the coefficients' axes."""
    irradiance: Floats
    """[3] RGB radiance of a white surface that faces it, were it a point; lit by it alone."""
    half_angle_rad: float


@dataclass(frozen=True)
class SplitLight:
    """A light in two parts."""

    rest: Floats
    """[bands^2, 3] radiance coefficients of what the discs leave."""
    discs: tuple[DirectLight, ...]
    """Strongest first."""


def split_light(coefficients: Floats) -> SplitLight:
    """The discs in a light of radiance `coefficients` [bands^2, 3], and the rest; no discs where it is soft."""
    return _split(np.ascontiguousarray(coefficients, np.float64).tobytes())


@lru_cache(_REMEMBERED)  # a light that is given is the same every frame
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
    """Of a lobe: how much is taken out, so that none comes or goes at once where an estimate changes."""
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
    """How much of `out` can be taken from `light`, at most 1, and the rest arrives from nowhere too far below zero."""
    basis = _basis(bands)
    arriving, taken = basis @ light, basis @ out
    allowed = np.maximum(LEAST_REST * arriving.mean(axis=0), -arriving.min(axis=0))
    return float(np.clip(np.min((arriving + allowed)[taken > 0] / taken[taken > 0], initial=1.0), 0.0, 1.0))
