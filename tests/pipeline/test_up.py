"""What is up, found from the scan where nobody says it: exact rooms, rendered rooms, a real kitchen."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
import pytest
from msgspec import structs
from pyopencl.cltypes import float4
from scipy.spatial.transform import Rotation

from client.options.source import open_source
from protocol.messages import Wishes
from server.client_session import ClientSession
from server.opencl.device import Device
from server.room.room import Room
from server.room.up_finder import FRAMES, PAUSE, patch_normals
from server.scene.placement import Placement
from server.service.saving.room_store import RoomStore
from tests.data import data_folder
from tests.scenes.analytic import Floats, sphere
from tests.scenes.kept_rooms import CUBE, client_of, scan
from tests.scenes.rooms import CAMERA, frame_at, view_at, wishes

UP = np.array([0.0, -1.0, 0.0])
PLACE = Placement(position_m=(-0.9, 0.6, 1.0))
ROUND = [sphere((-0.9, 0.4, 1.5), 0.9)]
"""Fills the picture and has no direction."""


def tilted(view: Floats, roll_deg: float = 20.0) -> Floats:
    """The view of a camera that is rolled about its axis."""
    turned = view.copy()
    turned[:3, :3] = view[:3, :3] @ Rotation.from_rotvec([0.0, 0.0, np.radians(roll_deg)]).as_matrix()
    return turned


def angle_deg(a: object, b: object) -> float:
    first, second = np.asarray(a, np.float64), np.asarray(b, np.float64)
    cosine = first @ second / np.linalg.norm(first) / np.linalg.norm(second)
    return float(np.degrees(np.arccos(np.clip(cosine, -1, 1))))


@pytest.fixture
def session(device: Device) -> Iterator[ClientSession]:
    opened = ClientSession(device, CAMERA, wishes("given"))
    yield opened
    opened.close()


def objects_up(session: ClientSession, name: str = "cube") -> tuple[Floats, Floats]:
    """Direction [3] of the cube's +z, its up, and place [3] of the middle of its floor, in the room."""
    place = np.asarray({kept.object_id: kept.place for kept in session._room.objects.kept()}[name])
    low, high = CUBE.bounds
    middle = np.array([*(low[:2] + high[:2]) / 2, low[2], 1.0])
    return place[:3, 2], (place @ middle)[:3]


def test_patches_are_flat_and_covered() -> None:
    """Of a picture of three patches across: a wall, one half wall and half floor, one with holes."""
    picture = np.zeros((8, 24, 4), np.float32)
    picture[..., 2:] = (-1, 1)
    picture[:, 12:16] = (0, -1, 0, 1)
    picture[::2, 16:] = 0
    normals = patch_normals(picture.view(float4).reshape(8, 24), across=3)
    np.testing.assert_allclose(normals, [[0, 0, -1]])


def test_one_frame_of_a_rolled_camera_shows_it(session: ClientSession) -> None:
    session.place_object("cube", CUBE, PLACE)
    view = tilted(view_at(0))
    result = session.process(frame_at(view, given=view))
    assert angle_deg(-view[:3, 1], UP) > 20
    assert angle_deg(result.light.up, UP) < 0.25  # seen: 0.1
    assert angle_deg(objects_up(session)[0], result.light.up) < 1e-4
    (told,) = [note for note in result.notes if "found from the scan" in note]
    assert "--up" in told
    assert "27 degrees" in told


def test_what_says_it_is_believed(device: Device) -> None:
    session = ClientSession(device, CAMERA, wishes("given", up=(0.0, -2.0, 0.2)))
    result = session.process(frame_at(view_at(0), given=view_at(0)))
    session.close()
    assert angle_deg(result.light.up, (0.0, -1.0, 0.1)) < 1e-4
    assert not [note for note in result.notes if "up" in note]


def test_it_is_refined_and_then_stays_and_objects_turn_with_it(session: ClientSession) -> None:
    session.place_object("cube", CUBE, PLACE)
    ups = []
    for step in range(FRAMES + 4):
        view = tilted(view_at(step))
        result = session.process(frame_at(view, step, noise_m=0.01, given=view))
        ups.append(result.light.up)
        direction, floor = objects_up(session)
        assert angle_deg(direction, session._room.objects.up) < 1e-4
        np.testing.assert_allclose(floor, PLACE.position_m, atol=1e-9)
    assert len(set(ups[:FRAMES])) > 1
    assert len(set(ups[FRAMES - 1 :])) == 1
    assert angle_deg(ups[-1], UP) < 0.5  # seen: 0.2


def test_the_same_frames_give_the_same_bits(device: Device) -> None:
    def found() -> list[bytes]:
        session = ClientSession(device, CAMERA, wishes("given"))
        ups = []
        for step in range(3):
            view = tilted(view_at(step))
            session.process(frame_at(view, step, noise_m=0.01, given=view))
            ups.append(session._room.objects.up.tobytes())
        session.close()
        return ups

    assert found() == found()


def test_where_nothing_shows_it_the_camera_does_until_something_does(session: ClientSession) -> None:
    session.place_object("cube", CUBE, PLACE)
    view = tilted(view_at(0))
    first = session.process(frame_at(view, scene=ROUND, given=view))
    assert angle_deg(first.light.up, -view[:3, 1]) < 1e-4
    (told,) = [note for note in first.notes if "taken from the first camera" in note]
    assert "--up" in told
    for step in range(1, FRAMES + PAUSE + 1):
        away = tilted(view_at(0), 20.0 + step)
        result = session.process(frame_at(away, step, scene=ROUND, given=away))
        assert result.light.up == first.light.up
        assert not [note for note in result.notes if "up" in note]
    for step in range(FRAMES + PAUSE + 1, FRAMES + 2 * PAUSE + 2):
        seen = tilted(view_at(0.1 * step - 3))  # about the views of which one frame is enough
        result = session.process(frame_at(seen, step, given=seen))
    assert angle_deg(result.light.up, UP) < 0.5  # seen: 0.19
    assert angle_deg(objects_up(session)[0], UP) < 0.5  # seen: 0.19


def test_the_second_client_of_a_room_has_the_rooms_up(device: Device) -> None:
    room = Room(device, wishes("given"), "study")
    elsewhere = np.eye(4)
    elsewhere[:3, :3] = Rotation.from_rotvec([0.3, 0.2, -0.5]).as_matrix()
    first = client_of(device, room, wishes("given"))
    second = client_of(device, room, wishes("given"), room_from_world=tuple(elsewhere.T.ravel()))  # rigid: inverse
    for step in range(FRAMES + 1):
        view = tilted(view_at(step))
        mine = first.process(frame_at(view, step, given=view)).light.up
    view = tilted(view_at(FRAMES), -30.0)
    theirs = second.process(frame_at(view, 0, given=elsewhere @ view)).light.up
    for client in (first, second):
        client.close()
    room.close()
    assert angle_deg(mine, UP) < 0.1  # seen: 0.014
    assert angle_deg(theirs, elsewhere[:3, :3] @ np.array(mine)) < 0.1  # its place is fitted to the scan


def test_a_saved_room_keeps_its_own(device: Device, tmp_path: Path) -> None:
    room = Room(device, wishes("given"), "study")
    client = client_of(device, room, wishes("given"))
    scan(client, range(2))
    store, up = RoomStore(tmp_path), room.objects.up
    store.save(room)
    client.close()
    room.close()
    loaded = RoomStore(tmp_path).load("study", device)
    assert loaded is not None
    again = client_of(device, loaded, wishes("given"))
    scan(again, range(2, 5))
    np.testing.assert_array_equal(loaded.objects.up, up)
    again.close()
    loaded.close()


def measured_points(folder: Path, frames: range, step_px: int = 8) -> Floats:
    """[n, 3] world: the raw depth of some frames, up to 3 m."""
    points = []
    for frame in frames:
        depth = cv2.imread(str(folder / f"data/frame-{frame:06d}.depth.png"), cv2.IMREAD_UNCHANGED) / 1000.0
        pose = np.loadtxt(folder / f"data/frame-{frame:06d}.pose.txt")
        v, u = np.mgrid[: depth.shape[0] : step_px, : depth.shape[1] : step_px]
        z = depth[v, u]
        in_camera = np.stack([(u - 320) / 585 * z, (v - 240) / 585 * z, z], axis=-1)[(z > 0) & (z < 3)]
        points.append(in_camera @ pose[:3, :3].T + pose[:3, 3])
    return np.concatenate(points)


def level_planes(points: Floats, camera_up: Floats, count: int, most_m: float = 0.015) -> Floats:
    """[count, 3] unit normals of the largest planes that face within 45 degrees of `camera_up` (RANSAC)."""
    random, normals = np.random.default_rng(0), list[Floats]()
    while len(normals) < count:
        best = np.zeros(len(points), np.bool_)
        for a, b, c in points[random.integers(len(points), size=(600, 3))]:
            normal = np.cross(b - a, c - a)
            normal /= max(float(np.linalg.norm(normal)), 1e-9)
            on_plane = np.abs((points - a) @ normal) < most_m
            if abs(normal @ camera_up) > np.cos(np.radians(45)) and on_plane.sum() > best.sum():
                best = on_plane
        for _ in range(5):
            own = points[best]
            normal = np.linalg.svd(own - own.mean(axis=0), full_matrices=False)[2][2]
            best = np.abs((points - own.mean(axis=0)) @ normal) < most_m
        normals.append(normal * np.sign(normal @ camera_up))
        points = points[~best]
    return np.array(normals)


def test_the_kitchens_is_that_of_its_floor_and_table(device: Device) -> None:
    """Carpet and table, as planes through the raw depth of 20 frames, agree within a degree."""
    folder = data_folder("rgbd_7scenes_redkitchen")
    source = open_source(str(folder))
    camera_up = -np.asarray(source[0].world_from_camera)[:3, 1]
    planes = level_planes(measured_points(folder, range(0, 200, 10)), camera_up, 2)
    up = planes.mean(axis=0)
    assert max(angle_deg(up, plane) for plane in planes) < 0.6  # seen: 0.24
    assert angle_deg(camera_up, up) > 25
    session = ClientSession(device, source.camera, Wishes(voxel_m=0.01))
    session.place_object("cube", CUBE, Placement(position_m=(0.0, 0.0, 1.5)))
    result = session.process(source[0])
    direction = objects_up(session)[0]
    session.close()
    assert angle_deg(result.light.up, up) < 1.5  # seen: 0.7
    assert angle_deg(direction, up) < 1.5


@pytest.mark.parametrize("name", ["r1_ceiling", "r2_spots", "r3_two", "r4_window"])
def test_rendered_rooms_whose_up_is_withheld(device: Device, name: str) -> None:
    source = open_source(str(data_folder("rooms") / name))
    assert source.up is not None
    session = ClientSession(device, source.camera, structs.replace(Wishes(), voxel_m=0.02))
    result = session.process(source[0])
    session.close()
    assert angle_deg(-source[0].world_from_camera[:3, 1], source.up) > 25
    assert angle_deg(result.light.up, source.up) < 1.0  # seen: 0.5
