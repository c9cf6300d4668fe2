"""Distant lights of exactly 16 coefficients: a soft disc in the sky and uniform ambient light.

The disc is symmetric about its direction, so the l = 1 coefficients of every colour point exactly there. Units are
those of the linear picture: an unshadowed white surface that faces the disc has radiance `EXPOSURE`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cache

import numpy as np
from numpy.typing import NDArray

from client.synthetic.lighting.harmonics import LAMBERT, basis

RING_SIZE = 8
ELEVATION_RAD = math.radians(40)
EXPOSURE = 1.18
"""Surfaces have at most albedo 0.8, so no pixel exceeds 0.95 of the picture's range."""

DISC_CORE_RAD, DISC_EDGE_RAD = math.radians(15), math.radians(40)
"""The disc is uniform up to the first angle and 0 from the second."""
AMBIENT_SHARE = 0.25
"""Share of ambient light in the irradiance of a surface that faces the disc."""
DISC_COLOR = np.array([1.0, 0.94, 0.84])
AMBIENT_COLOR = np.array([0.86, 0.93, 1.0])

_BANDS = np.arange(4)
_ZONAL_NORM = np.sqrt((2 * _BANDS + 1) / (4 * np.pi))


@dataclass(frozen=True)
class DistantLight:
    """A distant light."""

    direction: NDArray[np.float64]
    """[3] unit, world: dominant direction, towards the light."""
    sh: NDArray[np.float64]
    """[16, 3] radiance, linear RGB."""

    def radiance(self, directions: NDArray[np.floating]) -> NDArray[np.floating]:
        """[n, 3] radiance from unit `directions` [n, 3]; never negative."""
        return basis(directions) @ self.sh.astype(directions.dtype)


def ring_light(position: float, brightness: float = 1.0) -> DistantLight:
    """A light of the ring: azimuth `position` * 45 degrees from +z towards +x, elevation 40 degrees."""
    azimuth = 2 * math.pi * position / RING_SIZE
    level = math.cos(ELEVATION_RAD)
    direction = np.array([level * math.sin(azimuth), math.sin(ELEVATION_RAD), level * math.cos(azimuth)])
    return disc_light(direction, brightness)


def disc_light(direction: NDArray[np.float64], brightness: float = 1.0) -> DistantLight:
    """The disc around unit `direction` [3] with ambient light; at most `brightness` * `EXPOSURE`."""
    disc = _disc_zonal()
    per_band = np.repeat(disc / _ZONAL_NORM, 2 * _BANDS + 1) * basis(direction[None])[0]
    ambient = np.zeros(16)
    ambient[0] = math.sqrt(4 * math.pi)  # radiance 1 from all directions
    facing_disc = per_band @ (LAMBERT * basis(direction[None])[0])
    sh = (1 - AMBIENT_SHARE) / facing_disc * np.outer(per_band, DISC_COLOR) + AMBIENT_SHARE * np.outer(
        ambient, AMBIENT_COLOR
    )
    brightest = ((LAMBERT * basis(direction[None])[0]) @ sh).max()
    return DistantLight(direction, sh * (brightness * EXPOSURE / brightest))


@cache
def _disc_zonal() -> NDArray[np.float64]:
    """[4] zonal coefficients of the disc, windowed until it is positive with half of the ambient light."""
    nodes, weights = np.polynomial.legendre.leggauss(200)
    legendre = np.polynomial.legendre.legvander(nodes, 3) * _ZONAL_NORM
    disc = 2 * np.pi * (weights * _profile(np.arccos(nodes))) @ legendre
    facing_disc = disc @ (np.array([1, 2 / 3, 1 / 4, 0]) * _ZONAL_NORM)
    floor = 0.5 * AMBIENT_SHARE / (1 - AMBIENT_SHARE) * facing_disc
    for strength in np.linspace(0, 2, 401):
        windowed: NDArray[np.float64] = disc / (1 + strength * (_BANDS * (_BANDS + 1)) ** 2 / 36)
        if (legendre @ windowed).min() >= -floor:
            return windowed
    raise AssertionError("no window makes the light positive")


def _profile(angle: NDArray[np.float64]) -> NDArray[np.float64]:
    """1 inside the core, 0 outside the edge, smooth between."""
    x = np.clip((DISC_EDGE_RAD - angle) / (DISC_EDGE_RAD - DISC_CORE_RAD), 0, 1)
    return x * x * (3 - 2 * x)
