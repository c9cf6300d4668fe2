"""Surfaces told apart by colour and lightness: known mixtures, known colours, the same from call to call."""

from __future__ import annotations

import numpy as np
import pytest

from server.maths.sh import LUMINANCE
from server.maths.surfaces import (
    COLOR_RADIUS,
    LEAST_GAP,
    LEAST_SPREAD,
    MOST_MATERIALS,
    Surfaces,
    light_of_surfaces,
    lightness_levels,
    one_albedo,
)
from tests.scenes.analytic import Floats

GREY, RED, BLUE = np.array([0.5, 0.5, 0.5]), np.array([0.8, 0.3, 0.25]), np.array([0.2, 0.3, 0.8])


def mixture(levels: list[float], shares: list[float], spread: float, count: int = 1500) -> Floats:
    """[count] values about `levels`, in a random order."""
    rng = np.random.default_rng(len(levels))
    return rng.choice(levels, count, p=shares) + spread * rng.normal(size=count)


@pytest.mark.parametrize(
    ("levels", "shares"),
    [
        ([0.3], [1.0]),
        ([-0.4, 0.4], [0.5, 0.5]),
        ([-1.6, 0.4], [0.7, 0.3]),
        ([-1.6, 0.4], [0.3, 0.7]),
        ([-0.9, 0.0, 0.9], [0.3, 0.3, 0.4]),
        ([-0.8, 0.0, 2.0], [0.4, 0.4, 0.2]),
    ],
)
@pytest.mark.parametrize("spread", [0.02, 0.08])
def test_known_mixtures_are_found(levels: list[float], shares: list[float], spread: float) -> None:
    values = mixture(levels, shares, spread)
    found = lightness_levels(values, np.ones(len(values)), MOST_MATERIALS)
    np.testing.assert_allclose(np.sort(found), levels, atol=0.05)


@pytest.mark.parametrize("spread", [0.0, 0.05, 0.2, 0.4])
def test_one_material_is_one_however_it_scatters(spread: float) -> None:
    values = mixture([0.2], [1.0], spread)
    found = lightness_levels(values, np.ones(len(values)), MOST_MATERIALS)
    assert found == pytest.approx([0.2], abs=0.03)


def test_materials_that_shading_could_be_are_one() -> None:
    """Nearer than LEAST_GAP, or a gradient without a gap."""
    near = mixture([0.0, 0.6 * LEAST_GAP], [0.5, 0.5], LEAST_SPREAD)
    assert len(lightness_levels(near, np.ones(len(near)), MOST_MATERIALS)) == 1
    slope = np.linspace(-0.5, 0.5, 1500)
    assert len(lightness_levels(slope, np.ones(1500), MOST_MATERIALS)) == 1


def test_no_more_levels_than_asked_for() -> None:
    values = mixture([-1.0, 0.0, 1.0], [0.3, 0.4, 0.3], 0.05)
    weights = np.ones(len(values))
    assert lightness_levels(values, weights, 1) == pytest.approx([values.mean()])
    assert len(lightness_levels(values, weights, 2)) <= 2


def test_levels_are_those_of_the_weight() -> None:
    """What weighs next to nothing makes no level, and an even mixture of uneven weights is an uneven one."""
    values = mixture([-0.5, 0.5], [0.5, 0.5], 0.05)
    silent = np.where(values > 0, 1e-6, 1.0)
    assert lightness_levels(values, silent, MOST_MATERIALS) == pytest.approx([-0.5], abs=0.02)
    uneven = np.where(values > 0, 0.4, 1.0)
    assert np.average(values, weights=uneven) == pytest.approx(-0.21, abs=0.03)
    np.testing.assert_allclose(np.sort(lightness_levels(values, uneven, 2)), [-0.5, 0.5], atol=0.05)


def scene(kinds: list[Floats], shares: list[float], seed: int = 0, count: int = 2000) -> tuple[Floats, Floats, Floats]:
    """Radiance and shading [n, 3] of surfaces of albedos `kinds` [3], and which each is of."""
    rng = np.random.default_rng(seed)
    kind = rng.choice(len(kinds), count, p=shares)
    shading = rng.uniform(0.05, 1.0, (count, 1)) * np.array([1.0, 0.9, 0.7])
    seen = np.array(kinds)[kind] * shading * np.exp(0.03 * rng.normal(size=(count, 3)))
    return seen, shading, kind


def test_colours_and_lightnesses_are_found() -> None:
    kinds = [GREY, 0.3 * GREY, RED, BLUE, 0.4 * BLUE]
    seen, shading, kind = scene(kinds, [0.3, 0.2, 0.2, 0.2, 0.1])
    found = Surfaces().albedos(seen, shading, np.ones(len(seen)))
    assert found.count == len(kinds)
    true = np.array([albedo @ LUMINANCE for albedo in kinds])
    lightness = np.array([np.median(found.lightness[kind == k]) for k in range(len(kinds))])
    np.testing.assert_allclose(lightness / lightness[0], true / true[0], rtol=0.05)
    assert found.lightness.mean() == pytest.approx(1.0)
    for k, albedo in enumerate(kinds):
        own = found.color[kind == k]
        assert np.ptp(own, axis=0).max() < 0.02 * own.max()  # a surface is of one colour
        both = (own.mean(axis=0) / albedo) / (found.color[kind == 0].mean(axis=0) / kinds[0])
        np.testing.assert_allclose(both / both[1], 1.0, rtol=0.05)  # relative to that of grey


def test_a_red_room_is_not_lit_red() -> None:
    """One red surface, however large, says little of the light; colours of many are grey in the mean."""
    one = light_of_surfaces(np.tile(RED, (50, 1)), np.ones(3), np.zeros(50, np.int64))
    assert np.abs(np.log(one / one[1])).max() < 0.1 * np.abs(np.log(RED / RED[1])).max()
    mostly_red = np.r_[np.zeros(900, np.int64), np.ones(100, np.int64)]
    two = light_of_surfaces(np.stack([RED, GREY])[mostly_red], np.ones(3), mostly_red)
    swapped = light_of_surfaces(np.stack([GREY, RED])[mostly_red], np.ones(3), mostly_red)
    np.testing.assert_allclose(two / two[1], swapped / swapped[1])


def test_surfaces_of_many_colours_show_that_of_the_light() -> None:
    rng = np.random.default_rng(7)
    light = np.array([1.3, 1.0, 0.7])
    albedos = np.exp(rng.normal(0.0, 0.3, (300, 3)))
    found = light_of_surfaces(albedos * light, np.ones(3), np.arange(300))  # what multiplies them takes the light away
    np.testing.assert_allclose(found * light / (found * light)[1], 1.0, atol=0.1)


def test_a_room_of_one_colour_is_grey() -> None:
    seen, shading, _ = scene([RED], [1.0])
    assert (Surfaces().albedos(seen, shading, np.ones(len(seen)), one_color=True).color == 1.0).all()


def test_by_colour_alone() -> None:
    kinds = [GREY, 0.3 * GREY, RED]
    seen, shading, kind = scene(kinds, [0.4, 0.3, 0.3])
    found = Surfaces().albedos(seen, shading, np.ones(len(seen)), materials=False)
    assert found.count == 2
    assert np.ptp(found.lightness[kind < 2]) < 1e-12
    assert found.lightness[kind == 2].mean() != pytest.approx(found.lightness[kind == 0].mean(), rel=0.01)


@pytest.mark.parametrize("apart", [0.5, 2.0])
def test_colours_are_one_within_a_radius(apart: float) -> None:
    """Colours between clusters would be their own anyhow; of two, one if they are near."""
    other = GREY * np.array([np.exp(apart * COLOR_RADIUS), 1.0, 1.0])
    seen, shading, _ = scene([GREY, other], [0.5, 0.5])
    found = Surfaces().albedos(seen, shading, np.ones(len(seen)), materials=False)
    assert found.count == (1 if apart < 1 else 2)


def test_colours_are_kept_from_call_to_call() -> None:
    """The same pictures give the same surfaces, and one that is out of view for a while is known when it comes back."""
    surfaces, kinds = Surfaces(), [GREY, RED, BLUE]
    first = surfaces.albedos(*scene(kinds, [0.4, 0.3, 0.3])[:2], np.ones(2000))
    again = surfaces.albedos(*scene(kinds, [0.4, 0.3, 0.3])[:2], np.ones(2000))
    assert again.count == first.count == 3
    np.testing.assert_allclose(again.lightness, first.lightness, rtol=1e-6)
    np.testing.assert_allclose(again.color, first.color, rtol=1e-6)
    centers = surfaces._colors
    without_blue = surfaces.albedos(*scene([GREY, RED], [0.5, 0.5], seed=1)[:2], np.ones(2000))
    assert without_blue.count == 2
    assert surfaces.albedos(*scene(kinds, [0.4, 0.3, 0.3], seed=2)[:2], np.ones(2000)).count == 3
    np.testing.assert_allclose(surfaces._colors, centers, atol=0.02)  # in the same order, where they were


def test_black_is_not_a_colour_of_its_own() -> None:
    """Where nothing shines, or nothing is sent back, numbers stay finite."""
    seen, shading, _ = scene([GREY], [1.0])
    seen[:100], shading[100:200] = 0.0, 0.0
    found = Surfaces().albedos(seen, shading, np.ones(len(seen)))
    assert np.isfinite(found.lightness).all()
    assert np.isfinite(found.color).all()
    assert (found.lightness > 0).all()


def test_one_albedo() -> None:
    albedos = one_albedo(5)
    assert albedos.count == 1
    np.testing.assert_array_equal(albedos.lightness, np.ones(5))
    np.testing.assert_array_equal(albedos.color, np.ones((5, 3)))
