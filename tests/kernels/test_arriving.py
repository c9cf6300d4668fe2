"""What arrives at a place: surface where it is met, what is beyond the scan elsewhere, against exact rays."""

from __future__ import annotations

import numpy as np
import pytest

from server.light.arriving import DIRECTIONS, arriving_radiance, arriving_sh, distant_light
from server.opencl.engine import Engine
from tests.reference.sh import sh_basis
from tests.scenes import lights
from tests.scenes.analytic import Floats
from tests.scenes.lights import random_directions
from tests.scenes.painted_walls import FLOOR, VOXEL_M, WALL, floor_beside_a_wall, paint, voxels_of
from tests.scenes.solids import SIDE_M, ball, fill_volume, hit

PLACES = np.array([[0.5, 0.4, 0.6], [0.2, 0.15, 0.3], [0.8, 0.8, 0.85]])
COLOR_STEP = 0.004
"""Colours are kept as roots of 8 or 9 bits: half a step of 1/255 is 2 sqrt(c) / 510 of the colour c."""


def beyond(points: Floats, directions: Floats) -> Floats:
    """Another radiance at every point and in every direction."""
    return 2.0 + points[:, None, :] + 0.5 * directions[None, :, :]


def test_against_exact_rays(engine: Engine) -> None:
    volume, scene = floor_beside_a_wall(engine)
    directions = random_directions(3000, 7)
    found, is_seen = arriving_radiance(engine, volume, PLACES, directions, beyond)
    elsewhere = beyond(PLACES, directions)
    sure = 0
    for place, radiance, seen, other in zip(PLACES, found, is_seen, elsewhere, strict=True):
        near, far = (
            hit(scene, np.broadcast_to(place, directions.shape), directions, by) for by in (2 * VOXEL_M, -2 * VOXEL_M)
        )
        with np.errstate(invalid="ignore"):
            at = place + np.where(np.isfinite(far), far, 0.0)[:, None] * directions
        is_met = np.isfinite(far) & (np.abs(at - SIDE_M / 2).max(axis=1) < SIDE_M / 2 - 0.04)
        is_missed = ~np.isfinite(near) | (
            np.abs(place + np.where(np.isfinite(near), near, 9.0)[:, None] * directions - SIDE_M / 2).max(axis=1)
            > SIDE_M / 2 + 0.04
        )
        is_wall = at[:, 2] < 0.2 + 0.03
        is_floor = (at[:, 2] > 0.2 + 0.06) & (at[:, 1] < 0.1 + 0.03)
        for where, color in ((is_met & is_wall & (at[:, 1] > 0.16), WALL), (is_met & is_floor, FLOOR)):
            assert seen[where].all()
            np.testing.assert_allclose(radiance[where], np.broadcast_to(color, (where.sum(), 3)), atol=COLOR_STEP)
            sure += where.sum()
        assert not seen[is_missed].any()
        np.testing.assert_array_equal(radiance[is_missed], other[is_missed])
        sure += is_missed.sum()
    assert sure > 0.7 * found.shape[0] * found.shape[1]


def test_white_furnace(engine: Engine) -> None:
    """Where surface and the light beyond are equally bright, every place receives that radiance and nothing else."""
    volume, _ = floor_beside_a_wall(engine)
    paint(engine, volume, np.full((*voxels_of(volume), 3), 0.25))
    sh, seen = arriving_sh(engine, volume, PLACES, distant_light(lights.uniform((0.25, 0.25, 0.25))))
    # 0.002 of 0.25: colours' steps; 1024 directions integrate 16 coefficients of a constant to 1e-3.
    np.testing.assert_allclose(sh, np.broadcast_to(lights.uniform((0.25,) * 3), sh.shape), atol=0.003 * 3.55)
    assert ((seen > 0.1) & (seen < 1)).all()


def test_surface_without_colour_and_backs_are_not_seen(engine: Engine) -> None:
    volume = fill_volume(engine, (ball((0.5, 0.5, 0.5), 0.2),), VOXEL_M)
    paint(engine, volume, np.full((*voxels_of(volume), 3), 0.25), has_color=False)
    light = lights.lobe_and_sky((0.2, 0.9, -0.3))
    sh, seen = arriving_sh(engine, volume, PLACES[:1] + 0.2, distant_light(light))
    assert seen[0] == 0
    np.testing.assert_allclose(sh[0], light, atol=2e-3 * np.abs(light).max())  # the light itself: quadrature only


@pytest.mark.parametrize("bands", [2, 4, 5])
def test_distant_light_is_the_same_everywhere_and_never_negative(bands: int) -> None:
    sh = np.random.default_rng(bands).normal(size=(bands * bands, 3))
    directions = random_directions(200, 3)
    found = distant_light(sh)(PLACES, directions)
    expected = np.maximum(sh_basis(directions, bands) @ sh, 0)
    assert found.shape == (3, 200, 3)
    np.testing.assert_allclose(found, np.broadcast_to(expected, found.shape), atol=1e-12)
    assert (expected == 0).any()


def test_a_place_is_given_in_the_world(engine: Engine) -> None:
    """The same scene in a volume whose origin is elsewhere in the world."""
    volume, _ = floor_beside_a_wall(engine)
    here, _ = arriving_sh(engine, volume, PLACES, distant_light(lights.uniform()))
    volume.origin_world = np.array([1.5, -0.25, 3.0])
    there, _ = arriving_sh(engine, volume, PLACES + volume.origin_world, distant_light(lights.uniform()))
    np.testing.assert_allclose(there, here, atol=4 * np.pi * 4 / DIRECTIONS)  # rounding: four rays at an edge
