"""The light at places through the whole spine: which places, in whose world, in which units, and what is kept."""

from __future__ import annotations

from contextlib import AbstractContextManager, nullcontext
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import trimesh
from msgspec import structs

from protocol.messages import ArrivingLight, Hello, Light, Wishes
from server.client_session import ClientSession
from server.light import told_places
from server.light.panorama import panorama_sh, read_panorama
from server.maths.rigid import inverse_rigid
from server.maths.sh import dominant_direction, dominant_intensity, rotate_sh
from server.opencl.device import Device
from server.reuse.temporal_reuse import ROUND
from server.room.room import Room
from server.scene.placement import Placement
from tests.reference.sh import sh_basis
from tests.scenes import lights, rooms
from tests.scenes.analytic import Floats
from tests.scenes.lights import degrees_between
from tests.scenes.lit_pole import BOUNDS, CAMERA, POLE_M, VIEW, frame
from tests.scenes.meshes import shape_of
from tests.scenes.rooms import frame_at, view_at

TOWARDS = (0.8, -0.6, 0.3)
LIGHT = lights.lobe_and_sky(TOWARDS)
PLACES = ((0.1, 0.1, 1.1), (0.0, -5.0, 1.2))
"""10 cm above the floor; and so far above that next to none of it is met."""
HEIGHT_M = 0.3


def wishes(**more: object) -> Wishes:
    light = tuple((float(r), float(g), float(b)) for r, g, b in LIGHT)
    return Wishes(volume_m=BOUNDS, voxel_m=0.01, up=(0.0, -1.0, 0.0), light=light, light_at=PLACES, **more)


def session(device: Device, **more: object) -> ClientSession:
    return ClientSession(device, CAMERA, wishes(**more))


def place_pole(pipeline: ClientSession, name: str = "pole") -> None:
    mesh = shape_of(trimesh.creation.box((0.08, 0.08, HEIGHT_M)))
    pipeline.place_object(name, mesh, Placement(position_m=POLE_M))


def coefficients(arriving: ArrivingLight) -> Floats:
    return np.array(arriving.sh)


@pytest.fixture
def light(device: Device) -> Light:
    pipeline = session(device)
    place_pole(pipeline)
    light = pipeline.process(frame()).light
    pipeline.close()
    return light


def test_the_view_then_places_then_objects(light: Light) -> None:
    assert [(at.of, at.index, at.object) for at in light.at] == [
        ("view", 0, None),
        ("place", 0, None),
        ("place", 1, None),
        ("object", 0, "pole"),
    ]
    view, near, far, pole = light.at
    assert light.position == view.position
    np.testing.assert_allclose([near.position, far.position], PLACES, rtol=1e-6)
    np.testing.assert_allclose(pole.position, np.array(POLE_M) - [0, HEIGHT_M / 2, 0], atol=1e-6)
    # The camera looks at the floor where the pole stands; what it sees ends at 4 m.
    to_view = np.array(view.position) - VIEW[:3, 3]
    assert degrees_between(to_view, VIEW[:3, 2]) < 10  # seen: 5.1
    assert view.position[1] < POLE_M[1]  # above the floor: y is down


def test_surface_is_met_near_the_floor_and_hardly_from_afar(light: Light) -> None:
    _, near, far, _ = light.at
    assert near.seen > 0.2
    assert 0 < far.seen < 0.012  # measured 0.0059
    np.testing.assert_allclose(coefficients(far), LIGHT, atol=0.015 * LIGHT.max())  # measured 0.0076
    assert degrees_between(far.dominant_direction, TOWARDS) < 0.85  # measured 0.42
    # From below comes what the floor sends, not the light's own radiance there.
    below = np.array([0.0, 1.0, 0.0])
    assert abs(radiance_along(coefficients(near), below) - radiance_along(LIGHT, below)) > 0.1  # measured 0.23


def radiance_along(sh: Floats, direction: Floats) -> float:
    return float((sh_basis(direction[None], 4) @ sh)[0].mean())


def test_what_follows_from_the_coefficients(light: Light) -> None:
    for at in light.at:
        np.testing.assert_allclose(at.dominant_direction, dominant_direction(coefficients(at)), atol=1e-12)
        assert at.dominant_intensity == pytest.approx(dominant_intensity(coefficients(at)))
        assert len(at.sh_std) == 16
        assert (at.spread_deg, at.valid) == (None, light.valid)
        # White light from everywhere is the same in all axes; C00 needs no turn.
        assert at.sh_webxr[:3] == pytest.approx(at.sh[0])


def test_the_light_at_a_place_is_its_panorama(device: Device, tmp_path: Path) -> None:
    """1024 directions against half a million pixels, through a file that another reader opens, in turned axes."""
    pipeline = session(device)
    pipeline.process(replace(frame(), exposure=1.0))
    told = pipeline.process(replace(frame(), index=1, exposure=0.5)).light
    assert told.exposure == 0.5
    for position, at in ((PLACES[0], told.at[1]), (None, told.at[0])):
        data, where = pipeline.panorama("hdr", position)
        np.testing.assert_allclose(where, at.position, atol=1e-6)
        (tmp_path / "sky.hdr").write_bytes(data)
        found = panorama_sh(read_panorama(tmp_path / "sky.hdr"), 3)
        expected = np.array(at.sh_webxr).reshape(9, 3)
        # Measured 0.0040 of the largest coefficient: the floor's edge between 1024 directions.
        np.testing.assert_allclose(found, expected, atol=0.008 * np.abs(expected).max())
    pipeline.close()


class Turn:
    """Of a session that always has to let another one go first."""

    given = 0

    def is_due(self) -> bool:
        return True

    def give_way(self, *, may_end: bool) -> None:  # noqa: ARG002 (of the protocol)
        self.given += 1

    def released(self) -> AbstractContextManager[None]:
        return nullcontext()


def test_a_panorama_lets_others_go_first_and_is_the_same(device: Device) -> None:
    pipeline = session(device)
    pipeline.process(frame())
    turn = Turn()
    assert pipeline.panorama("hdr", PLACES[0]) == pipeline.panorama("hdr", PLACES[0], nullcontext(turn))
    assert turn.given > 1
    pipeline.close()


def test_a_panorama_is_of_the_first_object_and_needs_a_frame(device: Device) -> None:
    pipeline = session(device)
    with pytest.raises(ValueError, match="there is no light yet"):
        pipeline.panorama("hdr")
    place_pole(pipeline)
    told = pipeline.process(frame()).light
    _, where = pipeline.panorama("exr")
    np.testing.assert_allclose(where, told.at[3].position, atol=1e-6)
    pipeline.close()


def test_a_still_view_keeps_the_light_and_a_moved_object_gets_another(device: Device, monkeypatch) -> None:
    pipeline = session(device)
    place_pole(pipeline)
    seen = [pipeline.process(replace(frame(), index=index)) for index in range(3 * ROUND)]
    assert seen[-1].is_reused
    asked: list[int] = []
    looked_up = told_places.RoomLight.arriving_at

    def counted(*arguments: object) -> object:
        asked.append(1)
        return looked_up(*arguments)  # type: ignore[arg-type]

    monkeypatch.setattr(told_places.RoomLight, "arriving_at", counted)
    still = pipeline.process(replace(frame(), index=3 * ROUND))
    assert still.is_reused
    assert not asked
    assert still.light.at == seen[-1].light.at
    pipeline.move_object("pole", Placement(position_m=(0.2, 0.2, 1.0)))
    moved = pipeline.process(replace(frame(), index=3 * ROUND + 1)).light
    assert len(asked) == 1
    np.testing.assert_allclose(moved.at[3].position, (0.2, 0.2 - HEIGHT_M / 2, 1.0), atol=1e-6)
    pipeline.close()


def test_the_middle_of_the_view_stays_while_a_camera_hardly_moves(device: Device) -> None:
    """It is 1 m away. The light told is that of the place told."""
    pipeline = session(device)
    places = []
    for index, shift_m in enumerate((0.0, 0.01, -0.02, 0.2, 0.21)):
        shown = frame()
        pose = shown.world_from_camera.copy()
        pose[0, 3] += shift_m
        places.append(pipeline.process(replace(shown, index=index, world_from_camera=pose)).light.position)
    first, *near, moved, beside = np.array(places)
    np.testing.assert_array_equal(near, [first, first])
    assert moved[0] - first[0] > 0.1
    np.testing.assert_array_equal(beside, moved)
    pipeline.close()


def test_a_lost_camera_keeps_the_light_of_the_last_frame(device: Device) -> None:
    pipeline = ClientSession(device, rooms.CAMERA, rooms.wishes("track", light_at=((0.0, 0.0, 1.0),)))
    for step in range(3):
        before = pipeline.process(frame_at(view_at(step), step))
    nothing = replace(frame_at(view_at(3), 3), depth=np.zeros((rooms.CAMERA.height, rooms.CAMERA.width), np.uint16))
    lost = pipeline.process(nothing)
    assert lost.tracking == "lost"
    assert lost.light.at == before.light.at
    assert lost.light.position == before.light.position
    pipeline.close()


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("far_m", [1e3, 1e4])
def test_places_at_the_ends_of_the_world(device: Device, far_m: float) -> None:
    """They receive the light from beyond the scan, whole."""
    asked = structs.replace(wishes(), light_at=((far_m, 0.0, 0.0), (-far_m, far_m, -far_m)))
    pipeline = ClientSession(device, CAMERA, asked)
    for at in pipeline.process(frame()).light.at[1:]:
        assert at.seen == 0
        np.testing.assert_allclose(coefficients(at), LIGHT, atol=2e-4 * LIGHT.max())  # seen: 8e-5
    pipeline.close()


def test_objects_beyond_the_limit_are_named(device: Device, monkeypatch) -> None:
    monkeypatch.setattr(told_places, "MOST_OBJECTS", 2)
    monkeypatch.setattr("server.room.client_light.MOST_OBJECTS", 2)
    pipeline = session(device)
    for name in "abc":
        place_pole(pipeline, name)
    result = pipeline.process(frame())
    assert [at.object for at in result.light.at if at.of == "object"] == ["a", "b"]
    assert "3 objects: only the first 2 are told a light of their own" in result.notes
    pipeline.close()


def test_a_client_of_another_world_is_told_in_its_own(device: Device) -> None:
    """Two clients of one room see the same: places, coefficients and directions differ by the turn of their worlds."""
    client_from_room = np.eye(4)
    client_from_room[:3, :3] = cv2.Rodrigues(np.array([0.2, 1.1, -0.3]))[0]
    client_from_room[:3, 3] = 0.7, -0.2, 1.5
    place = np.array([-0.9, 0.3, 1.0])
    there = client_from_room[:3, :3] @ place + client_from_room[:3, 3]
    light = tuple((float(r), float(g), float(b)) for r, g, b in LIGHT)
    asked = rooms.wishes("given", light=light, light_at=(tuple(place),))
    room = Room(device, asked, "study")
    hello = Hello(client="test", camera=rooms.CAMERA, wishes=asked, room="study")
    told = []
    for world, at in ((np.eye(4), place), (client_from_room, there)):
        said = structs.replace(hello, room_from_world=tuple(inverse_rigid(world).ravel().tolist()))
        mine = structs.replace(asked, light_at=(tuple(at.tolist()),))
        client = ClientSession(device, rooms.CAMERA, mine, room, said)
        told.append(client.process(frame_at(view_at(0), given=world @ view_at(0))).light.at[1])
        client.close()
    room.close()
    first, second = told
    np.testing.assert_allclose(second.position, there, atol=1e-9)  # exact but for rounding
    np.testing.assert_allclose(
        # Seen: 0.0003.
        np.array(second.sh),
        rotate_sh(coefficients(first), client_from_room[:3, :3]),
        atol=0.001 * np.max(first.sh),
    )
    turned = client_from_room[:3, :3] @ np.array(first.dominant_direction)
    assert degrees_between(second.dominant_direction, turned) < 0.05  # seen: 0.02
