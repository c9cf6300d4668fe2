"""The lights that a light is made of: sums of known ones, and what the intensities minimise."""

from __future__ import annotations

from math import pi

import numpy as np
import pytest
from numpy.typing import NDArray

from server.maths.directional_fit import directional_sh
from server.maths.dominant import dominant_lights, radiance_intensity
from server.maths.sh import LAMBERT_BANDS, band_of, dominant_direction, dominant_intensity, lambert_transfer
from tests.reference.sh import sh_basis, sphere_rule
from tests.scenes import lights
from tests.scenes.lights import degrees_between, random_directions, unit

Floats = NDArray[np.float64]


def apart(count: int, least_deg: float, seed: int) -> Floats:
    """[count, 3] random directions, each at least so far from the others."""
    for attempt in range(10_000):
        found = random_directions(count, 1000 * seed + attempt)
        if (found @ found.T - 2 * np.eye(count)).max() < np.cos(np.radians(least_deg)):
            return found
    raise AssertionError("no such directions")


def colors(count: int, seed: int) -> Floats:
    """[count, 3] irradiances of a factor of 3."""
    return np.random.default_rng(seed).uniform(0.5, 1.5, (count, 3))


def light_of(directions: Floats, irradiance: Floats, sky: float, bands: int, spread_rad: float = 0.0) -> Floats:
    """[bands^2, 3] written from the definition: delta lights of coefficients pi E Y(d), blurred by the heat kernel."""
    fading = np.exp(-band_of(bands**2) * (band_of(bands**2) + 1) * spread_rad**2 / 2)
    light = pi * sh_basis(directions, bands).T @ irradiance * fading[:, None]
    return light + lights.uniform((sky,) * 3, bands)


@pytest.mark.parametrize(("count", "bands", "least_deg"), [(1, 3, 0), (1, 4, 0), (2, 4, 60), (3, 4, 90), (3, 6, 60)])
@pytest.mark.parametrize("sharp", [False, True])
def test_each_of_several_directional_lights(count: int, bands: int, least_deg: float, sharp: bool) -> None:
    for seed in range(6):
        directions, irradiance = apart(count, least_deg, seed), colors(count, seed)
        found = dominant_lights(light_of(directions, irradiance, 0.3, bands), sharp=sharp)
        assert len(found) == count
        assert [light.intensity for light in found] == sorted((light.intensity for light in found), reverse=True)
        for direction, color in zip(directions, irradiance, strict=True):
            nearest = max(found, key=lambda light: float(light.direction @ direction))
            assert degrees_between(nearest.direction, direction) < 0.01  # seen: 0.0003
            np.testing.assert_allclose(nearest.irradiance, color, rtol=0.02)
            assert nearest.spread_rad < 0.1


def test_more_lights_than_bands_can_tell_are_not_made_up() -> None:
    assert len(dominant_lights(light_of(apart(3, 60, 1), colors(3, 1), 0.3, 3))) <= 2


@pytest.mark.parametrize("spread_rad", [0.2, 0.4, 0.7])
def test_a_soft_light_is_one_light(spread_rad: float) -> None:
    for direction in random_directions(5, 3):
        (found,) = dominant_lights(light_of(direction[None], np.array([[1.0, 0.8, 0.5]]), 0.1, 4, spread_rad))
        assert degrees_between(found.direction, direction) < 1e-3
        assert found.spread_rad == pytest.approx(spread_rad, abs=0.01)
        np.testing.assert_allclose(found.irradiance, [1.0, 0.8, 0.5], rtol=0.01)


def test_a_lobe_that_is_no_gaussian_is_one_light() -> None:
    (found,) = dominant_lights(lights.lobe_and_sky((0.3, 0.8, -0.2)))
    assert degrees_between(found.direction, (0.3, 0.8, -0.2)) < 1e-3


def test_lamps_left_and_right_whose_mean_is_above() -> None:
    """What one dominant direction cannot say (7.5)."""
    left, right = unit([-1.0, 0.3, 0.0]), unit([1.0, 0.3, 0.0])
    light = light_of(np.stack([left, right]), np.array([[1.0, 0.5, 0.2], [0.2, 0.5, 1.0]]), 0.2, 4)
    assert degrees_between(dominant_direction(light), (0, 1, 0)) < 40  # from where no light comes
    found = sorted(dominant_lights(light), key=lambda light: light.direction[0])
    assert len(found) == 2
    assert max(degrees_between(found[0].direction, left), degrees_between(found[1].direction, right)) < 1e-3
    assert found[0].irradiance[0] > 4 * found[0].irradiance[2]
    assert found[1].irradiance[2] > 4 * found[1].irradiance[0]


def test_noise_makes_no_lights() -> None:
    """1 % of noise: the light that is there, not more than 2 degrees off, and no other."""
    for seed in range(10):
        direction = random_directions(1, seed)
        light = light_of(direction, np.ones((1, 3)), 0.5, 4)
        light += 0.01 * np.linalg.norm(light) / 4 * np.random.default_rng(seed).normal(size=(16, 1))
        (found,) = dominant_lights(light)
        assert degrees_between(found.direction, direction[0]) < 1  # seen: 0.54


def test_an_even_sky_has_no_lights() -> None:
    assert dominant_lights(lights.uniform((1.0, 2.0, 3.0))) == ()
    assert dominant_lights(np.zeros((16, 3))) == ()


def test_precision_says_which_coefficients_count() -> None:
    """A light whose upper bands were not seen: their zeros say nothing if the precision says so."""
    direction = unit([0.5, -0.2, 0.7])
    light = light_of(direction[None], np.ones((1, 3)), 0.2, 4)
    light[4:] = 0
    precision = np.diag(np.where(band_of(16) < 2, 1.0, 1e-9))
    (found,) = dominant_lights(light, precision, sharp=True)
    assert degrees_between(found.direction, direction) < 1e-3
    np.testing.assert_allclose(found.irradiance, 1, rtol=1e-3)


def test_directional_sh_shades_facing_white_to_1() -> None:
    direction = unit([0.1, 0.7, -0.3])
    # The Lambert series to l = 5 is within 3 % of the clamped cosine (its l = 6 term is 13 / 2 * 2 / 128 / 2 = 5 %).
    assert lambert_transfer(direction, 6) @ directional_sh(direction, 0.0, 6) == pytest.approx(1, abs=0.06)


def intensity_of_least_error(light: Floats, weights: Floats) -> float:
    """Of Sloan's unit light along the dominant direction, by least squares on samples all over the sphere."""
    points, areas = sphere_rule(8, 16)
    basis = sh_basis(points, 3) * weights
    values = basis @ (light[:9] @ [0.2126, 0.7152, 0.0722])
    unit_light = basis @ (16 * pi / 17 * sh_basis(dominant_direction(light), 3))
    model = np.stack([unit_light, np.ones(len(points))], axis=1)
    root = np.sqrt(areas)
    return float(np.linalg.lstsq(root[:, None] * model, root * values, rcond=None)[0][0])


@pytest.mark.parametrize("seed", range(5))
def test_289_of_512_pi_minimises_the_radiance_error_and_867_of_316_pi_the_irradiance_error(seed: int) -> None:
    light = np.random.default_rng(seed).normal(size=(16, 3)) + 3 * lights.lobe((0.2, 0.5, 1.0))
    of_radiance = intensity_of_least_error(light, np.ones(9))
    of_irradiance = intensity_of_least_error(light, LAMBERT_BANDS[band_of(9)])
    assert radiance_intensity(light) == pytest.approx(of_radiance, rel=1e-12)
    assert dominant_intensity(light) == pytest.approx(of_irradiance, rel=1e-12)
    assert abs(of_radiance / of_irradiance - 1) > 0.01  # or the test could not tell them apart


def test_both_intensities_agree_on_a_directional_light() -> None:
    light = light_of(unit([[0.3, -0.5, 0.4]]), np.full((1, 3), 2.0), 0.5, 4)
    assert radiance_intensity(light) == pytest.approx(dominant_intensity(light), rel=1e-12)
    assert radiance_intensity(lights.uniform()) == 0
