"""How far a light may be off: standard deviations of its coefficients, and the angle of its dominant direction."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from server.light.shell.spread import LEAST_SPREAD_DEG, SPREAD_DOUBT, deviations, spread_deg
from tests.reference.sh import sh_basis
from tests.scenes.analytic import Floats
from tests.scenes.lights import lobe_and_sky, random_directions

WHITE = np.ones(3)
NOTHING = np.zeros((16, 16))
TILT_90 = 2.146
"""Radius that holds 90 % of a two-dimensional normal distribution."""


def turned(sh: Floats, rotation: Rotation, directions: Floats, to_sh: Floats) -> Floats:
    """Light `sh` [16, 3] turned as a whole, by its radiance along `directions`. to_sh: least squares from that."""
    return np.asarray(to_sh @ (sh_basis(rotation.inv().apply(directions), 4) @ sh))


def test_all_of_the_light_may_be_turned_by_the_least_spread() -> None:
    """Against lights that are turned about random axes; of a band all coefficients alike."""
    sh, directions = lobe_and_sky((0.3, 0.8, -0.2)), random_directions(200, 1)
    angle = np.radians(LEAST_SPREAD_DEG) / TILT_90
    vectors = angle * np.random.default_rng(2).normal(size=(3000, 3))
    to_sh = np.linalg.pinv(sh_basis(directions, 4))
    changes = np.array([turned(sh, Rotation.from_rotvec(vector), directions, to_sh) - sh for vector in vectors])
    found = deviations(sh, NOTHING, WHITE)
    np.testing.assert_array_equal(found[0], 0)
    for band in (1, 2, 3):
        of_band = slice(band**2, (band + 1) ** 2)
        expected = np.sqrt((changes[:, of_band] ** 2).mean(axis=(0, 1)))
        np.testing.assert_allclose(found[of_band], np.tile(expected, (2 * band + 1, 1)), rtol=0.05)  # seen: 0.03
    across = [np.degrees(np.hypot(*vector[:2])) for vector in vectors]  # of a direction along z
    assert np.mean(np.array(across) <= LEAST_SPREAD_DEG) == pytest.approx(0.9, abs=0.02)


def test_what_the_curvature_tells_is_added_in_its_colour() -> None:
    sh, tint = lobe_and_sky((0.3, 0.8, -0.2)), np.array([1.2, 1.0, 0.4])
    spreads = np.random.default_rng(3).uniform(0.01, 0.1, 16)
    found = deviations(sh, np.diag(spreads**2), tint)
    told = SPREAD_DOUBT * spreads[:, None] * tint
    np.testing.assert_allclose(found**2, told**2 + deviations(sh, NOTHING, tint) ** 2)


def test_a_light_without_direction_may_come_from_anywhere() -> None:
    assert spread_deg(np.eye(16)[0], NOTHING) == 180.0
    assert spread_deg(lobe_and_sky((0.0, 1.0, 0.0)) @ WHITE, NOTHING) == pytest.approx(LEAST_SPREAD_DEG)
