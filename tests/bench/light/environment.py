"""Compares lights as environments: directions, irradiance and environment maps (thesis 6.1.3.3).

No picture of unknown albedo fixes the scale of a light, so it is taken out first: the one factor, common to all
colours, that brings the estimate nearest to the truth.
"""

from __future__ import annotations

import math
from functools import cache

import numpy as np
from numpy.typing import NDArray

from server.maths.sh import lambert_transfer, luminance_sh, sh_basis, spherical_fibonacci

Floats = NDArray[np.float64]

NORMALS = 1024
"""Evenly spread normals that irradiance is compared over."""
CUBE_SIDE = 16
"""Pixels along an edge of the cube map that environments are compared on."""


def best_scale(estimated: Floats, true: Floats) -> float:
    """The factor of `estimated` with the least squared difference to `true`; 0 where the estimate is zero."""
    energy = float(np.sum(estimated * estimated))
    return float(np.sum(estimated * true)) / energy if energy > 0 else 0.0


def relative_rmse(estimated: Floats, true: Floats) -> float:
    """Root of the summed squared difference after one scale, over that of `true`."""
    return float(np.linalg.norm(best_scale(estimated, true) * estimated - true) / np.linalg.norm(true))


def irradiance_error(estimated: Floats, true: Floats) -> float:
    """Relative RMSE of the irradiance of two lights [n, 3], over all normals and colours, after one scale."""
    return relative_rmse(_irradiance(estimated), _irradiance(true))


def environment_difference(estimated: Floats, true: Floats) -> float:
    """Mean absolute difference of the luminance of two environment maps after one scale, over the truth's mean.

    The thesis's MSAD (6.1.3.3) is the median of it over all frames; as a ratio it does not depend on the units.
    """
    found, exact = (_cube_map(bands_of(light)) @ luminance_sh(light) for light in (estimated, true))
    return float(np.abs(best_scale(found, exact) * found - exact).mean() / np.abs(exact).mean())


def bands_of(light: Floats) -> int:
    """Bands of coefficients [bands^2, ...]. Raises ValueError for another number of them."""
    bands = math.isqrt(len(light))
    if bands * bands != len(light):
        raise ValueError(f"a light of {len(light)} coefficients has no whole number of bands")
    return bands


def cube_directions(side: int) -> Floats:
    """[6 side^2, 3] unit directions of the pixels of a cube map."""
    steps = (np.arange(side) + 0.5) * 2 / side - 1
    u, v = (grid.ravel() for grid in np.meshgrid(steps, steps))
    faces = [np.insert(np.stack([u, v], 1), axis, sign, axis=1) for axis in range(3) for sign in (-1.0, 1.0)]
    points: Floats = np.concatenate(faces)
    unit: Floats = points / np.linalg.norm(points, axis=1, keepdims=True)
    return unit


def lat_long_directions(height: int, world_from_map: Floats) -> Floats:
    """[height, 2 height, 3] unit world directions of a lat-long map: y up, -z in the middle, x to the right.

    world_from_map: [3, 3] rotation, for instance the inverse of `webxr_from_world`.
    """
    polar = (np.arange(height) + 0.5) * np.pi / height
    azimuth = (np.arange(2 * height) + 0.5) * np.pi / height - np.pi
    polar, azimuth = np.meshgrid(polar, azimuth, indexing="ij")
    level = np.sin(polar)
    inside = np.stack([level * np.sin(azimuth), np.cos(polar), -level * np.cos(azimuth)], -1)
    return np.asarray(inside @ world_from_map.T)


def radiance_from(light: Floats, directions: Floats) -> Floats:
    """[..., 3] radiance of `light` [n, 3] from unit `directions` [..., 3]; may be negative where bands are cut off."""
    return np.asarray(sh_basis(directions, bands_of(light)) @ light)


@cache
def _cube_map(bands: int) -> Floats:
    return sh_basis(cube_directions(CUBE_SIDE), bands)


def _irradiance(light: Floats) -> Floats:
    return np.asarray(lambert_transfer(spherical_fibonacci(NORMALS), bands_of(light)) @ light)
