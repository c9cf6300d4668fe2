"""Comparisons of lights: what they are blind to, what they see, and which way up the maps are."""

from __future__ import annotations

import numpy as np
import pytest

from server.maths.light_direction import direction_dot, direction_error_deg
from server.maths.sh import rotate_sh, webxr_from_world
from tests.bench.light.environment import (
    bands_of,
    best_scale,
    cube_directions,
    environment_difference,
    irradiance_error,
    lat_long_directions,
    radiance_from,
    relative_rmse,
)
from tests.reference.sh import open_transfer, sphere_rule
from tests.scenes.lights import Floats, lobe, lobe_and_sky, uniform


def turned(light: Floats, degrees: float) -> Floats:
    """About the world's z."""
    c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    return rotate_sh(light, np.array([[c, -s, 0], [s, c, 0], [0, 0, 1.0]]))


def test_one_scale_is_taken_out_and_only_one() -> None:
    light = lobe_and_sky((1, 2, 3))
    for compare in (irradiance_error, environment_difference, direction_error_deg, relative_rmse):
        assert compare(7.5 * light, light) == pytest.approx(0, abs=1e-5)
    assert best_scale(4 * light, light) == pytest.approx(0.25)
    assert irradiance_error(light * (1, 1, 0.5), light) > 0.05


def test_no_light_is_as_wrong_as_it_gets() -> None:
    light = lobe_and_sky((1, 2, 3))
    dark = np.zeros_like(light)
    assert irradiance_error(dark, light) == pytest.approx(1)
    assert environment_difference(dark, light) == pytest.approx(1)
    assert direction_dot(dark, light) == 0
    assert direction_error_deg(dark, light) == pytest.approx(90)
    assert best_scale(dark, light) == 0


@pytest.mark.parametrize("degrees", [3, 40, 179])
def test_turning_the_light_turns_its_direction(degrees: float) -> None:
    light = lobe_and_sky((1, 0, 0))
    assert direction_error_deg(turned(light, degrees), light) == pytest.approx(degrees, abs=1e-4)


def test_irradiance_error_against_quadrature() -> None:
    found, true = turned(lobe_and_sky((1, 2, 0)), 30), lobe_and_sky((1, 2, 0), color=(0.5, 0.9, 1))
    normals, weights = sphere_rule(12, 24)
    a, b = (open_transfer(normals, 4) @ light for light in (found, true))
    inner = lambda x, y: float((weights[:, None] * x * y).sum())  # noqa: E731
    scale = inner(a, b) / inner(a, a)
    expected = np.sqrt(inner(scale * a - b, scale * a - b) / inner(b, b))
    assert irradiance_error(found, true) == pytest.approx(expected, rel=0.01)


def test_environment_difference_of_a_sky_and_a_lobe() -> None:
    """A uniform sky against 1 + x: the scale is 1 / (1 + 1/3) of the lobe, differences by quadrature."""
    sky, lobed = uniform(), uniform()
    lobed[3] += np.sqrt(4 * np.pi / 3)
    points, weights = sphere_rule(64, 128)
    scale = 1 / (1 + 1 / 3)
    expected = (weights * np.abs(scale * (1 + points[:, 0]) - 1)).sum() / (4 * np.pi)
    assert environment_difference(lobed, sky) == pytest.approx(expected, rel=0.08)  # a cube map weighs its corners more


def test_cube_map_looks_everywhere() -> None:
    directions = cube_directions(8)
    assert directions.shape == (6 * 64, 3)
    np.testing.assert_allclose(np.linalg.norm(directions, axis=1), 1)
    np.testing.assert_allclose(directions.mean(axis=0), 0, atol=1e-12)
    for axis in np.eye(3):
        assert (directions @ axis).max() > 0.98
        assert (directions @ axis).min() < -0.98


def test_lat_long_has_up_at_the_top_and_the_view_in_the_middle() -> None:
    up, view = np.array([0, -1.0, 0]), np.array([0, 0, 1.0])
    directions = lat_long_directions(64, webxr_from_world(up, view).T)
    assert directions.shape == (64, 128, 3)
    assert directions[0].mean(axis=0) @ up > 0.99
    middle = directions[31:33, 63:65].mean(axis=(0, 1))
    assert middle @ view > 0.99
    right = directions[32, 96]
    assert right @ np.array([1.0, 0, 0]) > 0.99  # y down, z ahead: x is on the right


def test_radiance_is_brightest_towards_the_light() -> None:
    directions = lat_long_directions(64, np.eye(3))
    shown = radiance_from(lobe((0.6, 0.0, -0.8)), directions)[..., 1]
    row, column = np.unravel_index(shown.argmax(), shown.shape)
    assert directions[row, column] @ np.array([0.6, 0.0, -0.8]) > 0.995


def test_other_numbers_of_coefficients_are_refused() -> None:
    assert [bands_of(np.zeros((n * n, 3))) for n in range(2, 7)] == [2, 3, 4, 5, 6]
    with pytest.raises(ValueError, match="15 coefficients"):
        bands_of(np.zeros((15, 3)))
