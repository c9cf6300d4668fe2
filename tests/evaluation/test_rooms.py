"""Furnished rooms by chance: the same for the same seed, and of use whatever the seed."""

from __future__ import annotations

import json
from itertools import product
from pathlib import Path

import numpy as np
import pytest

from client.options.source import open_source
from tests.bench.rooms import __main__ as program
from tests.bench.rooms.furniture import LIGHTS, Room, camera_pose, furnished_room
from tests.bench.rooms.ground_truth import DEPTH_SCALE_M, FOCAL_PX, HEIGHT, WIDTH, directions, write_room
from tests.scenes.analytic import Floats

SEEDS = range(12)


def rooms(light: str = "ceiling") -> list[Room]:
    return [furnished_room(seed, light, is_large=is_large) for seed, is_large in product(SEEDS, (False, True))]


def is_inside(room: Room, place: Floats, margin: float) -> bool:
    low, high = room.size * [-0.5, -1.0, -0.5], room.size * [0.5, 0.0, 0.5]
    return bool(((place > low - margin) & (place < high + margin)).all())


def test_a_seed_is_a_room() -> None:
    one, again, other = furnished_room(3, "spots"), furnished_room(3, "spots"), furnished_room(4, "spots")
    assert [shape.kind for shape in one.shapes] == [shape.kind for shape in again.shapes]
    for shape, same in zip(one.shapes, again.shapes, strict=True):
        np.testing.assert_array_equal(shape.world_from_shape, same.world_from_shape)
        np.testing.assert_array_equal(shape.albedo, same.albedo)
    assert (one.size != other.size).all()


def test_walls_of_a_large_room_are_a_metre_farther() -> None:
    room, large = (furnished_room(3, "lamp", is_large=is_large) for is_large in (False, True))
    np.testing.assert_allclose(large.size - room.size, [2, 0, 2])
    for (_, place), (_, same) in zip(room.places[:4], large.places[:4], strict=True):
        np.testing.assert_array_equal(place, same)


@pytest.mark.parametrize("light", LIGHTS)
def test_everything_is_in_the_room_and_something_lights_it(light: str) -> None:
    for room in rooms(light):
        corners = [(x, y, z, 1.0) for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]
        for shape in room.shapes:
            flat = [corner for corner in corners if shape.kind != "rectangle" or corner[2] > 0]
            ends = np.array(flat) * ([1, 1, 0, 1] if shape.kind == "rectangle" else [1, 1, 1, 1])
            assert all(is_inside(room, end, 0.06) for end in (ends @ shape.world_from_shape.T)[:, :3])
            assert 0 < shape.albedo.min() <= shape.albedo.max() <= 0.9
        lamps = [shape for shape in room.shapes if shape.radiance is not None]
        assert lamps
        for lamp in lamps:  # a flat one sends from its front, which looks at the middle of the room
            place, facing = lamp.world_from_shape[:3, 3], lamp.world_from_shape[:3, 2]
            assert lamp.kind == "sphere" or facing @ ([0, -1.2, 0] - place) > 0


def test_places_are_free_and_the_camera_stays_inside() -> None:
    for room in rooms():
        solids = [np.linalg.inv(shape.world_from_shape) for shape in room.shapes if shape.kind == "cube"]
        for what, place in room.places:
            assert is_inside(room, place, 0.0)
            assert not any((np.abs(solid @ [*place, 1.0])[:3] < 1).all() for solid in solids), what
        for share, turns in product(np.linspace(0, 1, 7), (False, True)):
            pose = camera_pose(room, share, turns=turns)
            np.testing.assert_allclose(pose[:3, :3] @ pose[:3, :3].T, np.eye(3), atol=1e-12)
            assert np.linalg.det(pose[:3, :3]) > 0.99
            assert pose[1, 1] > 0.5, "its y axis points down"
            assert is_inside(room, pose[:3, 3], -0.3)


class _Wall:
    """In place of the path tracer: a grey wall two metres ahead."""

    def picture(self, _pose: Floats, _directions: object, _samples: int) -> Floats:
        return np.full((HEIGHT * WIDTH, 3), 0.2) * np.linspace(0.5, 2, HEIGHT * WIDTH)[:, None]

    def first_met(self, _pose: Floats, along: Floats) -> tuple[Floats, Floats, Floats]:
        return 2 / along[:, 2], np.full((len(along), 3), 0.5), np.tile([0.0, 0.0, -1.0], (len(along), 1))

    def light_at(self, place: Floats, _random: np.random.Generator) -> Floats:
        return np.full((16, 3), place[0])


def test_a_camera_that_turns_sees_all_walls_and_the_ceiling() -> None:
    room = rooms()[0]
    forward = np.array([camera_pose(room, share, turns=True)[:3, 2] for share in np.linspace(0, 1, 61)])
    turned = np.unwrap(np.arctan2(forward[:, 0], forward[:, 2]))
    assert abs(turned[-1] - turned[0]) == pytest.approx(2 * np.pi)
    half_view = HEIGHT / 2 / FOCAL_PX
    assert np.arcsin(-forward[:, 1].min()) + np.arctan(half_view) > np.radians(30)


def test_a_set_is_a_source_with_its_places(tmp_path: Path) -> None:
    room, said = furnished_room(1, "windows"), list[str]()
    write_room(tmp_path, room, _Wall(), 1, 3, 4, said.append, denoise=lambda picture, *_: picture)
    source = open_source(str(tmp_path))
    assert len(source) == 3
    frame = source[2]
    assert abs(frame.depth * DEPTH_SCALE_M - 2).max() < DEPTH_SCALE_M
    np.testing.assert_allclose(frame.world_from_camera, camera_pose(room, 1.0), atol=1e-6)
    assert 0.03 < (frame.color.max(-1) == 255).mean() < 0.15
    probes = json.loads((tmp_path / "probes.json").read_text())["probes"]
    assert [probe["what"] for probe in probes] == [what for what, _ in room.places]
    assert np.array(probes[0]["sh"]).shape == (16, 3)
    assert len(said) == 3 + 5


def test_rays_go_through_pixels() -> None:
    rays = directions(None)
    assert rays.shape == (HEIGHT * WIDTH, 3)
    middle = rays.reshape(HEIGHT, WIDTH, 3)[HEIGHT // 2 - 1 : HEIGHT // 2 + 1, WIDTH // 2 - 1 : WIDTH // 2 + 1]
    np.testing.assert_allclose(middle.mean((0, 1))[:2], 0, atol=1e-12)
    random = np.random.default_rng(0)
    spread = directions((random, 64))
    assert spread.shape == (HEIGHT * WIDTH, 64, 3)
    np.testing.assert_allclose(spread[1000].mean(0), rays[1000], atol=1e-3)


def test_what_cannot_be_made_is_refused_in_a_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert program.main([str(tmp_path)]) == 2
    assert "exists" in capsys.readouterr().err
    assert program.main([str(tmp_path / "new"), "--frames", "0"]) == 2
    assert "at least 1" in capsys.readouterr().err


def test_what_is_not_installed_is_named(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(program, "NEEDED", ("a_tracer_that_nobody_has",))
    assert program.main([str(tmp_path / "new")]) == 2
    said = capsys.readouterr().err
    assert "a_tracer_that_nobody_has not installed" in said
    assert said.count("\n") == 1
