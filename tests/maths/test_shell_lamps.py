"""Lamps on the shell: a disc of known place, size and radiance is found again, and even light has none."""

from __future__ import annotations

import numpy as np
import pytest

from server.light.shell.lamps import STRONG, WEAK, find_lamps
from server.light.shell.shell import Shell
from server.maths.dominant import MOST_LIGHTS
from server.maths.sh import spherical_fibonacci
from tests.scenes.analytic import Floats

ROOM = Shell(np.eye(3), np.zeros(3), np.array([4.0, 3.6, 2.4]), 0.0, np.zeros((2, 3)))
PLACE = np.array([1.7, 1.9, 0.6])
DIRECTIONS = spherical_fibonacci(4096)
AMBIENT = np.array([0.3, 0.3, 0.25])
NO_BLUR = np.zeros(len(DIRECTIONS))


def ends_of(place: Floats) -> Floats:
    starts = np.broadcast_to(place, DIRECTIONS.shape)
    return np.asarray(place + ROOM.distances(starts, DIRECTIONS).min(-1)[:, None] * DIRECTIONS)


def lit_by(*discs: tuple[Floats, float, Floats]) -> tuple[Floats, Floats]:
    """Ends, and radiance of discs (centre, radius, radiance) on the ceiling before an even light."""
    ends = ends_of(PLACE)
    radiance = np.tile(AMBIENT, (len(ends), 1))
    for center, radius_m, color in discs:
        radiance[np.linalg.norm(ends - center, axis=1) < radius_m] = color
    return ends, radiance


def irradiance(radiance: Floats) -> Floats:
    return np.asarray(4 * np.pi / len(DIRECTIONS) * radiance.sum(0))


def test_a_ceiling_lamp_is_found_where_it_is() -> None:
    center, radius_m, color = np.array([2.6, 1.2, 2.4]), 0.4, np.array([20.0, 18.0, 15.0])
    ends, radiance = lit_by((center, radius_m, color))
    lamps, parts = find_lamps(PLACE, ends, radiance, NO_BLUR)
    rest = parts.rest(ends, radiance)
    lamp = lamps[0]
    np.testing.assert_allclose(lamp.center, center, atol=0.06)
    assert lamp.radius_m == pytest.approx(radius_m, rel=0.15)
    np.testing.assert_allclose(
        lamp.radiance / lamp.radiance.sum(), (color - AMBIENT) / (color - AMBIENT).sum(), atol=0.01
    )
    even = 4 * np.pi * AMBIENT.sum()
    assert irradiance(rest).sum() - even < 0.25 * (irradiance(radiance).sum() - even)  # seen: .13
    assert (rest >= AMBIENT - 1e-9).all()


def test_lamps_and_rest_are_the_whole() -> None:
    """The irradiance that discs bring to a point that faces them, and the rest, add up."""
    ends, radiance = lit_by(
        (np.array([2.6, 1.2, 2.4]), 0.4, np.full(3, 20.0)), (np.array([0.6, 3.0, 2.4]), 0.3, np.full(3, 30.0))
    )
    lamps, parts = find_lamps(PLACE, ends, radiance, NO_BLUR)
    rest = parts.rest(ends, radiance)
    assert 2 <= len(lamps) <= MOST_LIGHTS
    brought = sum(
        (np.pi * lamp.radiance * lamp.radius_m**2 / ((lamp.center - PLACE) ** 2).sum() for lamp in lamps), np.zeros(3)
    )
    np.testing.assert_allclose(brought + irradiance(rest), irradiance(radiance), rtol=1e-9)


@pytest.mark.parametrize("radius_m", [0.6, 0.9])
def test_a_large_lamp_is_one(radius_m: float) -> None:
    """Its rim, which the window leaves, is no other lamp."""
    center = np.array([2.0, 1.8, 2.4])
    lamps, _ = find_lamps(PLACE, *lit_by((center, radius_m, np.full(3, 8.0))), NO_BLUR)
    assert len(lamps) == 1
    np.testing.assert_allclose(lamps[0].center, center, atol=0.1)
    assert lamps[0].radius_m == pytest.approx(radius_m, rel=0.15)


def test_even_light_has_no_lamps() -> None:
    ends, radiance = lit_by()
    lamps, parts = find_lamps(PLACE, ends, radiance, NO_BLUR)
    rest = parts.rest(ends, radiance)
    assert lamps == []
    np.testing.assert_array_equal(rest, radiance)


def test_a_weak_lamp_fades_in() -> None:
    """What is taken out grows without a jump as a lamp gets brighter."""
    taken = []
    for strength in np.linspace(0.0, 12.0, 60):
        ends, radiance = lit_by((np.array([2.6, 1.2, 2.4]), 0.4, AMBIENT + strength))
        rest = find_lamps(PLACE, ends, radiance, NO_BLUR)[1].rest(ends, radiance)
        taken.append(float(irradiance(radiance - rest).sum() / irradiance(radiance).sum()))
    assert taken[0] == 0.0
    assert taken[-1] > STRONG
    assert np.abs(np.diff(taken)).max() < WEAK


def test_what_lamps_leave_elsewhere_is_what_is_left_of_the_shell() -> None:
    """From another place, a lamp takes the same part of the shell."""
    center = np.array([2.6, 1.2, 2.4])
    parts = find_lamps(PLACE, *lit_by((center, 0.4, np.full(3, 20.0))), NO_BLUR)[1]
    points = center + np.random.default_rng(5).uniform(-0.4, 0.4, (200, 3)) * [1.0, 1.0, 0.0]
    radiance = np.where(np.linalg.norm(points - center, axis=1, keepdims=True) < 0.3, 20.0, AMBIENT)
    left = parts.rest(points, radiance)
    assert (left[radiance[:, 0] < 20] == AMBIENT).all()
    assert (left[radiance[:, 0] == 20] < 0.6 * 20).all()  # its middle is taken nearly whole, its rim less
