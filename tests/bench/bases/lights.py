"""Lights that no few coefficients hold exactly, and what is exactly known of them (B9).

A light is even in the cells around the directions of a lattice, and has discs besides. It is taken to come from the
lattice's directions and from ones spread over the discs: for pictures and figures alike, so there is no quadrature
error between them.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from math import pi

import numpy as np
from numpy.typing import NDArray

from server.light.panorama import panorama_directions
from server.maths.sh import GOLDEN_TURN, sh_basis, spherical_fibonacci
from tests.bench.light.environment import CUBE_SIDE, cube_directions

Floats = NDArray[np.float64]

LATTICE = 972
"""Directions: twelve times the estimator's."""
DISC_POINTS = 48
BRIGHTEST = 1.0
"""What a white unshadowed surface facing the light shades to: pictures of albedo 0.5 are far from clipped."""
_FINER = 4  # directions along an edge of a pixel of the environment map


@dataclass(frozen=True)
class Disc:
    """Even radiance from around a direction."""

    direction: Floats
    """[3] unit."""
    radius_rad: float
    radiance: Floats
    """[3]."""

    def points(self) -> Floats:
        """[DISC_POINTS, 3] unit directions of equal solid angle, in the manner of a sunflower."""
        index = np.arange(DISC_POINTS) + 0.5
        cosine = 1 - index / DISC_POINTS * (1 - np.cos(self.radius_rad))
        turn, sine = 2 * pi * GOLDEN_TURN * index, np.sqrt(1 - cosine**2)
        side = np.cross(self.direction, np.eye(3)[int(np.argmin(np.abs(self.direction)))])
        side /= np.linalg.norm(side)
        other = np.cross(self.direction, side)
        around = np.outer(np.cos(turn), side) + np.outer(np.sin(turn), other)
        return np.asarray(np.outer(cosine, self.direction) + sine[:, None] * around)

    @property
    def solid_angle(self) -> float:
        """Steradians."""
        return float(2 * pi * (1 - np.cos(self.radius_rad)))


@dataclass(frozen=True)
class HardLight:
    """A light, world axes, +y up."""

    name: str
    even: Floats
    """[LATTICE, 3] radiance of the lattice's cells."""
    discs: tuple[Disc, ...]

    def directions(self) -> Floats:
        """[n, 3] unit, that it comes from: the lattice's, then the discs'."""
        return np.concatenate([lattice(), *(disc.points() for disc in self.discs)])

    def flux(self) -> Floats:
        """[n, 3] radiance times solid angle from `directions`."""
        discs = [np.tile(d.radiance * d.solid_angle / DISC_POINTS, (DISC_POINTS, 1)) for d in self.discs]
        return np.concatenate([self.even * (4 * pi / LATTICE), *discs])

    def sh(self, bands: int) -> Floats:
        """[bands^2, 3] its coefficients."""
        return np.asarray(sh_basis(self.directions(), bands).T @ self.flux())

    def irradiance(self, normals: Floats) -> Floats:
        """[n, 3] of white unshadowed surfaces with unit `normals` [n, 3], over pi."""
        return np.asarray(np.maximum(normals @ self.directions().T, 0) @ self.flux() / pi)

    def cube_map(self) -> Floats:
        """[6 CUBE_SIDE^2, 3] mean radiance in the pixels of an environment map (environment.cube_directions)."""
        finer = _fine_directions()
        radiance = self.even[_nearest()]
        for disc in self.discs:
            inside = finer @ disc.direction >= np.cos(disc.radius_rad)
            radiance = radiance + inside[..., None] * disc.radiance
        return np.asarray(radiance.mean(axis=1))

    def scaled(self) -> HardLight:
        """The same, as bright as BRIGHTEST says."""
        factor = BRIGHTEST / float(self.irradiance(spherical_fibonacci(400)).max())
        discs = tuple(Disc(d.direction, d.radius_rad, d.radiance * factor) for d in self.discs)
        return HardLight(self.name, self.even * factor, discs)


@cache
def lattice() -> Floats:
    """[LATTICE, 3] unit directions of equal solid angle."""
    return spherical_fibonacci(LATTICE)


def sun(azimuth_rad: float) -> HardLight:
    """A sun 5 degrees wide and 40 high, that gives 60 % of the light, and a blue sky over grey ground."""
    level = np.clip(0.5 + 2 * lattice()[:, 1:2], 0, 1)
    sky = level * np.array([0.45, 0.65, 1.0]) + (1 - level) * np.array([0.25, 0.22, 0.2])
    disc = _disc_giving(azimuth_rad, 40, 2.5, np.array([1.0, 0.9, 0.72]) * 1.5 * sky.mean())
    return HardLight("sun and sky", sky, (disc,)).scaled()


def two_lamps(azimuth_rad: float) -> HardLight:
    """A warm lamp and a cold one, 16 degrees wide, a third of a turn apart, and a little light from everywhere."""
    warm = _disc_giving(azimuth_rad, 55, 8, np.array([1.0, 0.75, 0.5]))
    cold = _disc_giving(azimuth_rad + 2 * pi / 3, 30, 8, np.array([0.45, 0.6, 0.9]))
    return HardLight("two lamps", np.full((LATTICE, 3), 0.1), (warm, cold)).scaled()


def disc(azimuth_rad: float) -> HardLight:
    """The thesis's disc light (6.1.3.1) with its edge: even to 25 degrees around a direction 45 high, and ambient."""
    white = np.ones(3)
    wide = _disc_giving(azimuth_rad, 45, 25, 0.75 * white)
    return HardLight("disc", np.full((LATTICE, 3), 0.25), (wide,)).scaled()


def of_panorama(name: str, panorama: Floats, azimuth_rad: float) -> HardLight:
    """A lat-long picture [h, w, 3] of radiance, +y up, turned about it: each cell the mean of what lies in it."""
    height, width = panorama.shape[:2]
    around, up = np.sin(azimuth_rad), np.cos(azimuth_rad)
    turn = np.array([[up, 0, around], [0, 1, 0], [-around, 0, up]])
    directions = panorama_directions(height, width).reshape(-1, 3) @ turn.T
    heights = np.cos(np.linspace(0, pi, height + 1))
    weights = np.repeat(heights[:-1] - heights[1:], width)
    cell = np.concatenate([np.argmax(part @ lattice().T, 1) for part in np.array_split(directions, 64)])
    total = np.bincount(cell, weights, LATTICE)
    sums = [np.bincount(cell, weights * panorama[..., c].ravel(), LATTICE) for c in range(3)]
    return HardLight(name, np.stack(sums, 1) / np.maximum(total, 1e-12)[:, None], ()).scaled()


def _disc_giving(azimuth_rad: float, height_deg: float, radius_deg: float, facing: Floats) -> Disc:
    """The disc that shades what faces it to `facing` [3]."""
    height, radius = np.deg2rad(height_deg), np.deg2rad(radius_deg)
    level = np.cos(height)
    direction = np.array([level * np.sin(azimuth_rad), np.sin(height), level * np.cos(azimuth_rad)])
    return Disc(direction, float(radius), facing / np.sin(radius) ** 2)


@cache
def _fine_directions() -> Floats:
    """[6 CUBE_SIDE^2, _FINER^2, 3] directions within the pixels of the environment map."""
    side = CUBE_SIDE * _FINER
    grid = cube_directions(side).reshape(6, CUBE_SIDE, _FINER, CUBE_SIDE, _FINER, 3)
    return np.ascontiguousarray(grid.transpose(0, 1, 3, 2, 4, 5)).reshape(6 * CUBE_SIDE**2, _FINER**2, 3)


@cache
def _nearest() -> NDArray[np.int64]:
    """[6 CUBE_SIDE^2, _FINER^2] cell of the lattice that each fine direction lies in."""
    parts = np.array_split(_fine_directions().reshape(-1, 3), 32)
    found = np.concatenate([np.argmax(part @ lattice().T, axis=1) for part in parts])
    return found.reshape(-1, _FINER**2)
