"""The message of a light: units of the frame's image, the rule of `valid`, and places in another world."""

from __future__ import annotations

import numpy as np
import pytest

from protocol.limits import VALID_SPREAD_DEG
from protocol.messages import ArrivingLight, Light
from server.light.light_estimation import LightEstimate
from server.light.light_message import LightPlaces, light_message
from server.light.place_light import LitPlace, Place, PlaceLight
from server.maths.sh import rotate_sh, webxr_from_world
from tests.scenes import lights
from tests.scenes.lights import degrees_between

AXES = webxr_from_world(np.array([0.0, 0.0, 1.0]), np.array([0.6, 0.8, 0.0]))
ROOM, HERE = lights.lobe_and_sky((0.3, -0.8, 0.2)), 2.0 * lights.lobe_and_sky((-0.5, -0.1, 0.6))
STD = np.random.default_rng(2).uniform(0.01, 0.1, (16, 3))
POSITION = np.array([0.5, -0.25, 2.0])


def told(exposure: float = 1.0, spread_deg: float | None = None, *, valid: bool = True, **place: object) -> Light:
    estimate = LightEstimate(ROOM, STD, 3.0, valid, spread_deg)
    here = PlaceLight(POSITION, HERE, STD, spread_deg, valid, **place)
    places = LightPlaces(POSITION, [LitPlace(Place("object", 3, POSITION, "sofa"), here)])
    return light_message(7, 0.25, estimate, AXES, (), exposure, places)


def at_of(light: Light) -> ArrivingLight:
    (at,) = light.at
    return at


def test_places_are_told_with_what_follows_from_their_own_coefficients() -> None:
    light = told(seen=0.25)
    at = at_of(light)
    assert (at.of, at.index, at.object, at.seen) == ("object", 3, "sofa", 0.25)
    assert light.position == at.position == tuple(POSITION)
    np.testing.assert_allclose(at.sh, HERE)
    np.testing.assert_allclose(at.sh_std, STD)
    assert degrees_between(at.dominant_direction, (-0.5, -0.1, 0.6)) < 1e-4
    assert degrees_between(light.dominant_direction, (0.3, -0.8, 0.2)) < 1e-4
    np.testing.assert_allclose(np.array(at.sh_webxr).reshape(9, 3), rotate_sh(HERE[:9], AXES), atol=1e-12)


def test_all_radiance_is_in_units_of_the_frames_image() -> None:
    whole, half = told(), told(0.5)
    for one, other in ((whole, half), (at_of(whole), at_of(half))):
        for name in ("sh", "sh_std", "sh_webxr", "dominant_intensity"):
            np.testing.assert_allclose(getattr(other, name), 0.5 * np.array(getattr(one, name)), rtol=1e-12)
        assert other.dominant_direction == pytest.approx(one.dominant_direction)


@pytest.mark.parametrize(
    ("spread_deg", "otherwise", "expected"),
    [
        (None, True, True),
        (None, False, False),
        (0.0, False, True),
        (VALID_SPREAD_DEG, False, True),
        (VALID_SPREAD_DEG + 0.01, True, False),
        (180.0, True, False),
    ],
)
def test_a_direction_is_valid_by_its_spread(spread_deg: float | None, otherwise: bool, expected: bool) -> None:
    light = told(spread_deg=spread_deg, valid=otherwise)
    assert (light.valid, at_of(light).valid) == (expected, expected)
    assert light.spread_deg == at_of(light).spread_deg == spread_deg


def test_deviations_that_are_not_known_are_null() -> None:
    here = PlaceLight(POSITION, HERE, None, None, valid=True)
    estimate = LightEstimate(ROOM[:9], None, np.inf, valid=False)
    light = light_message(
        0, 0.0, estimate, AXES, places=LightPlaces(POSITION, [LitPlace(Place("view", 0, POSITION), here)])
    )
    assert light.sh_std == at_of(light).sh_std == ((None, None, None),) * 16
    assert light.sh[9:] == ((0.0, 0.0, 0.0),) * 7
    assert light.condition is None


def test_places_turn_into_a_clients_world() -> None:
    """A quarter turn about y: what comes from +x there comes from -z here."""
    quarter = np.eye(4)
    quarter[:3, :3] = [[0, 0, 1], [0, 1, 0], [-1, 0, 0]]
    quarter[:3, 3] = 1.0, 2.0, 3.0
    place = PlaceLight(np.array([1.0, 0.0, 0.0]), lights.lobe((1, 0, 0)), STD, 5.0, valid=True)
    seen = LightPlaces(place.position, [LitPlace(Place("place", 0, place.position), place)]).seen_from(quarter)
    np.testing.assert_allclose(seen.view, [1.0, 2.0, 2.0])
    (lit,) = seen.lit
    np.testing.assert_allclose(lit.light.position, [1.0, 2.0, 2.0])
    np.testing.assert_allclose(lit.place.position, [1.0, 2.0, 2.0])
    np.testing.assert_allclose(lit.light.sh, lights.lobe((0, 0, -1)), atol=1e-9)
    # The deviation of a band's sum of squares stays, as the turn is orthogonal.
    for band in (slice(0, 1), slice(1, 4), slice(4, 9), slice(9, 16)):
        np.testing.assert_allclose((lit.light.std[band] ** 2).sum(0), (STD[band] ** 2).sum(0), rtol=1e-6)
