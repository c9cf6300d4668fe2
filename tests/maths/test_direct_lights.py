"""Lights taken out of a light for shadow maps: small ones are found, nothing is lost or gained, soft ones stay."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from server.maths.direct_lights import LEAST_GAIN, LEAST_REST, lamp_at, split_light
from server.maths.directional_fit import directional_sh
from server.maths.dominant import dominant_lights
from server.maths.sh import lambert_transfer, sh_basis
from tests.scenes import lights
from tests.scenes.lights import degrees_between, random_directions

Floats = NDArray[np.float64]
TOWARD = lights.unit([[0.3, -0.8, 0.5], [-0.7, -0.6, -0.4]])
COLORS = np.array([[1.2, 1.0, 0.8], [0.5, 0.6, 0.9]])


def light_of(spread_deg: float, sky: float = 0.3, count: int = 2, bands: int = 4) -> Floats:
    """[bands^2, 3] round lobes over an even sky."""
    light = lights.uniform((sky,) * 3, bands)
    for direction, color in zip(TOWARD[:count], COLORS, strict=False):
        light += np.outer(directional_sh(direction, np.radians(spread_deg), bands), color)
    return light


@pytest.mark.parametrize(("bands", "count"), [(3, 1), (4, 2), (5, 2)])
def test_small_lights_are_found_whole(bands: int, count: int) -> None:
    split = split_light(light_of(12.0, bands=bands, count=count))
    assert len(split.discs) == count
    for disc, direction, color in zip(split.discs, TOWARD, COLORS, strict=False):
        assert degrees_between(disc.direction, direction) < 0.01  # seen: 0.0001
        np.testing.assert_allclose(disc.irradiance, color, rtol=0.02)
        assert np.degrees(disc.half_angle_rad) == pytest.approx(1.75 * 12.0, rel=0.1)
    arriving = sh_basis(random_directions(500, 1), bands) @ split.rest
    np.testing.assert_allclose(arriving, 0.3, atol=0.02)  # the sky


def test_soft_lights_stay_where_they_are() -> None:
    for light in (light_of(35.0), lights.lobe_and_sky(TOWARD[0]), lights.uniform(), np.zeros((16, 3))):
        split = split_light(light)
        assert split.discs == ()
        np.testing.assert_array_equal(split.rest, light)


def test_two_bands_tell_no_spread() -> None:
    assert split_light(light_of(5.0, bands=2)).discs == ()


@pytest.mark.parametrize("spread_deg", [0.0, 10.0, 22.0, 25.0])
@pytest.mark.parametrize("sky", [0.3, 0.0])
def test_both_parts_are_the_light(spread_deg: float, sky: float) -> None:
    """White surface that nothing hides: the rest's harmonics and the discs shade it as all harmonics do, but for what
    the discs have in bands that the light has not: at most 3/32 of a clamped cosine, which bands 4 and up hold."""
    light = light_of(spread_deg, sky)
    split = split_light(light)
    normals = random_directions(300, 2)
    discs = sum(
        shading_of_disc(disc.direction, disc.half_angle_rad, normals)[:, None] * disc.irradiance for disc in split.discs
    )
    whole, parts = (lambert_transfer(normals, 4) @ sh for sh in (light, split.rest))
    allowed = (3 / 32 + 0.04) * sum(
        disc.irradiance for disc in split.discs
    )  # and discs of a lobe's spread are no lobes
    assert (np.abs(parts + discs - whole) <= allowed + 1e-9).all()
    assert np.abs(np.mean(parts + discs - whole, axis=0)).max() < 0.01 * np.mean(whole)


def test_what_the_rest_arrives_with_stays_above_its_bound() -> None:
    """Real lights of bands that were cut off go below zero by themselves; what is left does not go farther."""
    random = np.random.default_rng(5)
    found = 0
    for seed in range(20):
        light = light_of(5.0, 0.05) + 0.1 * random.normal(size=(16, 3))
        split = split_light(light)
        basis = sh_basis(random_directions(2000, seed), 4)
        arriving, rest = basis @ light, basis @ split.rest
        allowed = np.maximum(LEAST_REST * 0.2821 * light[0], -arriving.min(axis=0))
        assert (rest.min(axis=0) >= -allowed - 0.02).all()  # between the directions that are looked at
        found += len(split.discs)
    assert found >= 20


@pytest.mark.parametrize(("dark", "most"), [(0.7, 0.95), (0.9, 0.4)])
def test_less_is_taken_where_the_rest_would_be_darker_than_dark(dark: float, most: float) -> None:
    """A light with a hole beside it, which the lobe that fits it covers: what arrives stays above the bound, and
    lobe and rest are still the light."""
    side = lights.unit(np.cross(TOWARD[0], [0.0, 0.0, 1.0]))
    hole = np.cos(0.35) * TOWARD[0] + np.sin(0.35) * side
    light = np.outer(directional_sh(TOWARD[0], 0.15, 4), (1.0, 1.0, 0.8)) + lights.uniform((0.05,) * 3)
    light -= np.outer(directional_sh(hole, 0.15, 4), dark * np.array([1.0, 0.2, 0.8]))
    split = split_light(light)
    (disc,) = split.discs
    (lobe,) = dominant_lights(light, least_gain=LEAST_GAIN)
    share = disc.irradiance / lobe.irradiance
    np.testing.assert_allclose(share, share[0])
    assert 0.1 < share[0] < most
    taken = np.outer(directional_sh(lobe.direction, lobe.spread_rad, 4), disc.irradiance)
    np.testing.assert_allclose(split.rest + taken, light, atol=1e-9)
    basis = sh_basis(random_directions(4000, 1), 4)
    arriving, rest = (basis @ sh for sh in (light, split.rest))
    allowed = np.maximum(LEAST_REST * 0.2821 * light[0], -arriving.min(axis=0))
    assert (rest.min(axis=0) >= -allowed - 0.02).all()
    assert (basis @ (light - taken / share[0]) < -allowed - 0.02).any()  # all of the lobe would be too much


def test_hand_over_is_gradual() -> None:
    """From sharp to soft, what is taken out lessens, without a step."""
    spreads = np.arange(15.0, 32.0, 0.5)
    taken = [sum(disc.irradiance.mean() for disc in split_light(light_of(s, count=1)).discs) for s in spreads]
    assert taken[0] == pytest.approx(COLORS[0].mean(), rel=0.03)
    assert taken[-1] == 0
    steps = -np.diff(taken)
    assert steps.min() > -0.02
    assert steps.max() < 0.12


def test_brighter_light_is_split_alike() -> None:
    one, ten = split_light(light_of(14.0)), split_light(10 * light_of(14.0))
    np.testing.assert_allclose(ten.rest, 10 * one.rest, rtol=1e-4, atol=1e-4)


def shading_of_disc(direction: Floats, half_angle_rad: float, normals: Floats) -> Floats:
    """[n] of white surface: a quadrature over points of the disc that lie evenly on a plane across it."""
    side = np.cross(direction, np.eye(3)[np.abs(direction).argmin()])
    side /= np.linalg.norm(side)
    index = np.arange(400)
    radius, turn = np.tan(half_angle_rad) * np.sqrt((index + 0.5) / len(index)), np.pi * (3 - 5**0.5) * index
    across = np.cross(direction, side)
    points = direction + radius[:, None] * (np.cos(turn)[:, None] * side + np.sin(turn)[:, None] * across)
    shading: Floats = np.maximum(normals @ lights.unit(points).T, 0).mean(axis=1)
    return shading


def test_a_lamp_gives_the_form_factor_of_its_disc() -> None:
    """Of a disc of radius r at distance d that faces a surface it is r^2 / (r^2 + d^2). Shading takes all parts of the
    disc to be as far as its centre: it is that to the second order of r / d, from all sides."""
    center, radiance = np.array([1.0, 2.0, -1.0]), np.array([3.0, 2.0, 1.0])
    lamp = lamp_at(center, 0.2, radiance)
    for offset in ([0.0, 1.0, 0.0], [2.0, -1.0, 0.5], [0.0, 0.0, -4.0]):
        seen = lamp.seen_from(center - offset)
        distance = float(np.linalg.norm(offset))
        share = (0.2 / distance) ** 2
        np.testing.assert_allclose(seen.direction, np.array(offset) / distance)
        np.testing.assert_allclose(seen.irradiance, share * radiance)
        facing = shading_of_disc(seen.direction, seen.half_angle_rad, seen.direction[None])[0]
        assert share * facing == pytest.approx(share / (1 + share), rel=2 * share)
