"""Light from far away as non-negative combinations of smooth lobes."""

from __future__ import annotations

from functools import cache

import numpy as np
from numpy.typing import NDArray

from server.maths.sh import sh_basis, spherical_fibonacci

WIDTH_DEG = 35.0
"""Standard deviation of a lobe: narrower ones are not told apart by how diffuse surface is shaded (Ramamoorthi and
Hanrahan 2001: bands above the second are shaded by less than 3 %)."""
LOBES = 51
"""1.5 for every square width of the sphere."""
_DIRECTIONS = 4096  # of sums over the sphere

Floats = NDArray[np.float64]


@cache
def lobe_directions() -> Floats:
    """[LOBES, 3] unit."""
    return spherical_fibonacci(LOBES)


def lobes_along(directions: Floats) -> NDArray[np.float32]:
    """[n, LOBES] radiance of the lobes along unit `directions` [n, 3]; all together are close to 1 everywhere."""
    return _heights(directions) * _scale()


@cache
def lobes_to_sh(bands: int) -> Floats:
    """[bands^2, LOBES]: coefficients of lobes."""
    directions = spherical_fibonacci(_DIRECTIONS)
    return np.asarray(sh_basis(directions, bands).T @ lobes_along(directions) * (4 * np.pi / _DIRECTIONS))


def _heights(directions: Floats) -> NDArray[np.float32]:
    cosines = directions.astype(np.float32) @ lobe_directions().T.astype(np.float32)
    return np.asarray(np.exp(-0.5 * (np.arccos(np.clip(cosines, -1, 1)) / np.float32(np.radians(WIDTH_DEG))) ** 2))


@cache
def _scale() -> np.float32:
    return np.float32(1 / (_heights(spherical_fibonacci(_DIRECTIONS)).mean() * LOBES))
