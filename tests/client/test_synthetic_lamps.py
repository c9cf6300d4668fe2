"""synthetic:lamp: its light against the inverse-square law, its shadows against a ray's exact hits."""

from __future__ import annotations

import numpy as np
import pytest

from client.errors import SourceError
from client.synthetic.lighting.lamps import BULB_RADIUS_M, PLACES_M, Lamp, lamplight, room_lamps
from client.synthetic.solids.polyhedra import box
from client.synthetic.solids.round import Sphere
from client.synthetic.source import SyntheticSource, open_synthetic

SMALL = "size=96x72"
LAMP = Lamp(np.array([0.2, 1.5, -0.3]), np.array([2.0, 1.0, 0.5]))


def lamp_source(more: str = "") -> SyntheticSource:
    return open_synthetic(f"synthetic:lamp?{SMALL}{more}")


def test_inverse_square_and_cosine() -> None:
    points = np.array([[0.2, 0.0, -0.3], [1.2, 0.5, -0.3], [0.2, 0.0, -0.3]])
    normals = np.array([[0.0, 1, 0], [0, 1, 0], [0, -1, 0]])
    light = lamplight((LAMP,), (), points, normals)
    np.testing.assert_allclose(light[0], LAMP.intensity / (np.pi * 1.5**2))
    np.testing.assert_allclose(light[1], LAMP.intensity * np.sqrt(0.5) / (np.pi * 2.0))
    assert not light[2].any()


def test_shadows_end_where_they_should() -> None:
    """A ball of 0.2 m half way down casts a shadow of 0.4 m and a little more: the cone that touches it."""
    ball = Sphere(np.array([0.2, 0.75, -0.3]), 0.2)
    x = np.linspace(-1, 1, 2001)
    points = np.stack([x + 0.2, 0 * x, 0 * x - 0.3], 1)
    lit = lamplight((LAMP,), (ball,), points, np.tile([0.0, 1, 0], (2001, 1)))[:, 0] > 0
    edge = 1.5 * np.tan(np.arcsin(0.2 / 0.75))
    np.testing.assert_array_equal(lit, np.abs(x) > edge)
    behind = box((0.2, -0.5, -0.3), (2, 0.2, 2))
    assert lamplight((LAMP,), (behind,), points[:1], np.array([[0.0, 1, 0]])).all()


def test_all_the_light_of_a_lamp_arrives() -> None:
    """On the inside of a sphere around the lamp falls its whole power, 4 pi times its intensity."""
    random = np.random.default_rng(1)
    directions = random.normal(size=(40_000, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    center = LAMP.position + np.array([0.1, 0.2, -0.1])
    arriving = lamplight((LAMP,), (), center + directions, -directions) * np.pi
    np.testing.assert_allclose(arriving.mean(0) * 4 * np.pi, 4 * np.pi * LAMP.intensity, rtol=0.02)


@pytest.mark.parametrize("place", range(len(PLACES_M)))
def test_places_are_free(place: int) -> None:
    source = lamp_source(f"&place={place}")
    (lamp,) = source.lamps
    for solid in source.scene.solids:
        if solid.bounds is None:  # the room itself
            assert not solid.contains(lamp.position[None]).any()
            continue
        around = lamp.position + 2 * BULB_RADIUS_M * np.vstack([np.zeros(3), np.eye(3), -np.eye(3)])
        assert not solid.contains(around).any()


@pytest.mark.parametrize("count", [0, 1, 2])
def test_lamps_add_to_the_sky(count: int) -> None:
    dark, lit = lamp_source("&lamps=0").truth(20), lamp_source(f"&lamps={count}").truth(20)
    assert len(lit.lamps) == count
    surface = lit.albedo[..., 0] > 0
    np.testing.assert_allclose(lit.radiance[surface], (dark.radiance + lit.lamplight)[surface], atol=1e-12)
    assert lit.lamplight.any() == (count > 0)
    assert not lit.dynamic.any()
    np.testing.assert_array_equal(lit.sh, dark.sh)


def test_bulbs_are_seen_and_clip() -> None:
    source = lamp_source("&place=1")
    frame, truth = source[20], source.truth(20)
    bulb = truth.visible & (truth.albedo[..., 0] == 0)
    assert bulb.sum() > 3
    assert (frame.color[bulb] == 255).all()
    center = truth.lamps[0].position
    camera = source.camera
    v, u = np.nonzero(bulb)
    z = truth.depth_m[bulb].astype(float)
    points = np.stack([(u - camera.cx) / camera.fx * z, (v - camera.cy) / camera.fy * z, z, 0 * z + 1])
    world = (source.pose(20) @ points)[:3].T
    np.testing.assert_allclose(np.linalg.norm(world - center, axis=1), BULB_RADIUS_M, atol=1e-6)


def test_two_lamps_differ() -> None:
    first, second = room_lamps(2, 0)
    assert np.linalg.norm(first.position - second.position) > 0.5
    assert first.intensity[2] / first.intensity[0] < second.intensity[2] / second.intensity[0]


@pytest.mark.parametrize("bad", ["lamp?lamps=3", "lamp?place=99", "lamp?lamps=-1", "room?lamps=1"])
def test_what_is_refused(bad: str) -> None:
    with pytest.raises(SourceError):
        open_synthetic(f"synthetic:{bad}")
