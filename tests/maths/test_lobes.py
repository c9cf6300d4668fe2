"""Distant lobes: even over the sphere, and the same light as rays and as harmonics."""

from __future__ import annotations

import numpy as np

from server.maths.lobes import LOBES, lobe_directions, lobes_along, lobes_to_sh
from server.maths.sh import sh_basis, spherical_fibonacci


def test_together_they_are_an_even_sky() -> None:
    even = lobes_along(spherical_fibonacci(3000)).sum(axis=1)
    np.testing.assert_allclose(even, 1.0, atol=0.1)


def test_each_is_brightest_along_its_own_direction() -> None:
    found = lobes_along(lobe_directions())
    assert (found.argmax(axis=1) == np.arange(LOBES)).all()


def test_harmonics_are_the_integral_over_the_sphere() -> None:
    """By the product rule in cosine and angle, which is exact to 1e-4 for lobes 35 degrees wide."""
    cosines, weights = np.polynomial.legendre.leggauss(60)
    angles = 2 * np.pi * np.arange(120) / 120
    sines = np.sqrt(1 - cosines**2)
    directions = np.stack(
        [
            np.outer(sines, np.cos(angles)).ravel(),
            np.outer(sines, np.sin(angles)).ravel(),
            np.repeat(cosines, len(angles)),
        ],
        axis=1,
    )
    measure = np.repeat(weights, len(angles)) * 2 * np.pi / len(angles)
    exact = (sh_basis(directions, 4) * measure[:, None]).T @ lobes_along(directions)
    np.testing.assert_allclose(lobes_to_sh(4), exact, atol=1e-3)
