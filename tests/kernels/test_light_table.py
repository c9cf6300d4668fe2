"""The table of a light: its radiance along all directions, from each place."""

from __future__ import annotations

import numpy as np
import pytest

from server.maths.direct_lights import DirectLight, SplitLight
from server.maths.light_places import LightPlaces
from server.opencl.engine import Engine
from server.shading.traced_scene import DeviceLight, upload_light
from server.transfer.radiance_transfer import direction_sets
from tests.reference import light_table
from tests.scenes.analytic import Floats
from tests.scenes.solids import download4

PLACES = LightPlaces(np.array([[0.25, 0.25, 0.45], [0.71, 0.25, 0.45]]), (1, 0))


def random_light(bands: int, seed: int = 1) -> Floats:
    return np.random.default_rng(seed).normal(size=(2, bands * bands, 3))


def arriving(engine: Engine, light: DeviceLight) -> Floats:
    return download4(engine, light.table.array("arriving"))[..., :3].reshape(len(light.sh), -1, 3)


@pytest.mark.parametrize("bands", [2, 4, 6])
@pytest.mark.parametrize("count", [25, 81])
def test_it_holds_what_arrives_from_each_direction(engine: Engine, bands: int, count: int) -> None:
    sh, rays = random_light(bands), direction_sets(count, bands)
    light = upload_light(engine, sh, rays, exposure=2.0, places=PLACES)
    expected = light_table.arriving(2 * sh, rays.directions[..., :3].reshape(-1, 3).astype(float))
    np.testing.assert_allclose(arriving(engine, light), expected, atol=2e-5)  # of values up to 10
    np.testing.assert_allclose(download4(engine, light.table.array("positions"))[:, :3], PLACES.positions, rtol=1e-6)
    np.testing.assert_array_equal(engine.download(light.table.array("owners")), PLACES.owners)
    assert (expected == 0).any()


def test_discs_are_not_in_it(engine: Engine) -> None:
    """Also while the table of the whole light is in use."""
    whole, rest, rays = random_light(4), random_light(4, seed=2), direction_sets(81, 4)
    disc = DirectLight(np.array([0.0, 1.0, 0.0]), np.ones(3), 0.1)
    of_whole = upload_light(engine, whole, rays, places=PLACES)
    of_rest = upload_light(engine, whole, rays, places=PLACES, split=SplitLight(rest, (disc,)))
    directions = rays.directions[..., :3].reshape(-1, 3).astype(float)
    for light, sh in ((of_whole, whole), (of_rest, rest)):
        np.testing.assert_allclose(arriving(engine, light), light_table.arriving(sh, directions), atol=1e-5)
        np.testing.assert_allclose(download4(engine, light.table.array("whole"))[..., :3], whole, rtol=1e-6)


def test_a_light_that_stays_is_not_tabulated_again(engine: Engine) -> None:
    sh, rays, fewer = random_light(4), direction_sets(81, 4), direction_sets(25, 4)
    first = arriving(engine, upload_light(engine, sh, rays, places=PLACES))
    launches = []
    for given, along in ((sh, rays), (2 * sh, rays), (sh, rays), (sh, fewer), (sh, rays)):
        engine.profile.begin()
        light = upload_light(engine, given, along, places=PLACES)
        launches.append(engine.profile.launches)
    assert launches == [0, 1, 1, 1, 1]
    np.testing.assert_array_equal(arriving(engine, light), first)


def test_a_table_that_was_left_half_made_is_made_again(engine: Engine, monkeypatch: pytest.MonkeyPatch) -> None:
    sh, rays = random_light(4), direction_sets(81, 4)
    first = arriving(engine, upload_light(engine, sh, rays, places=PLACES))

    def refuse(*_: object, **__: object) -> None:
        raise InterruptedError

    with monkeypatch.context() as patch:
        patch.setattr(engine, "launch", refuse)
        with pytest.raises(InterruptedError):
            upload_light(engine, 2 * sh, rays, places=PLACES)
    again = upload_light(engine, sh, rays, places=PLACES)
    np.testing.assert_array_equal(arriving(engine, again), first)
    np.testing.assert_allclose(download4(engine, again.table.array("whole"))[..., :3], sh, rtol=1e-6)
