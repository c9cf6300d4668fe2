"""Spherical harmonics as polynomials: they are the basis, and their gradients are its derivatives."""

from __future__ import annotations

import numpy as np
import pytest

from server.maths.sh import band_of
from server.maths.sh_polynomials import sh_with_slope
from tests.reference.sh import sh_basis
from tests.scenes.lights import random_directions


@pytest.mark.parametrize("bands", [1, 2, 4, 6])
def test_values_on_and_off_the_sphere(bands: int) -> None:
    directions, length = random_directions(20, 1), np.linspace(0.5, 2.0, 20)[:, None]
    expected = sh_basis(directions, bands)
    np.testing.assert_allclose(sh_with_slope(directions, bands)[0], expected, atol=1e-12)
    scaled = length ** band_of(bands**2) * expected
    np.testing.assert_allclose(sh_with_slope(length * directions, bands)[0], scaled, atol=1e-10)


@pytest.mark.parametrize("bands", [1, 2, 4, 6])
def test_gradients_against_differences(bands: int) -> None:
    points, step = 1.3 * random_directions(10, 2), 1e-5
    gradients = sh_with_slope(points, bands)[1]
    assert gradients.shape == (10, bands**2, 3)
    for axis in range(3):
        move = step * np.eye(3)[axis]
        ahead, behind = (sh_with_slope(points + sign * move, bands)[0] for sign in (1, -1))
        # Third derivatives of degree 5 at r = 1.3 times step^2 / 6, and float64's 1e-16 / step.
        np.testing.assert_allclose(gradients[..., axis], (ahead - behind) / (2 * step), atol=1e-7)


def test_no_points() -> None:
    values, gradients = sh_with_slope(np.zeros((0, 3)), 4)
    assert (values.shape, gradients.shape) == ((0, 16), (0, 16, 3))
