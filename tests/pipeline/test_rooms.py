"""Clients in one room: what each knows adds, worlds that differ are laid on one another, contradictions stay out."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from dataclasses import replace

import cv2
import numpy as np
import pytest
import trimesh
from msgspec import structs

from protocol.frames import RgbdFrame, Viewpoint
from protocol.messages import Hello, Light, Marker
from server.client_session import ClientSession
from server.maths.registration import angle_between, distance_between
from server.maths.rigid import inverse_rigid
from server.opencl.device import Device
from server.pipeline import FrameResult
from server.room.room import Room
from server.scene.placement import Placement
from tests.scenes import corners
from tests.scenes.analytic import Floats
from tests.scenes.corners import FLOOR, WALL, corner_frame, degrees_across
from tests.scenes.lights import degrees_between, lobe_and_sky
from tests.scenes.meshes import shape_of
from tests.scenes.rooms import BOUNDS, CAMERA, VOXEL_M, frame_at, view_at, wishes

TOWARDS = (0.5, 0.8, 0.0)
LIGHT = 0.3 * lobe_and_sky(TOWARDS)
ELSEWHERE = np.eye(4)
ELSEWHERE[:3, :3] = cv2.Rodrigues(np.array([0.2, 1.1, -0.3]))[0]
ELSEWHERE[:3, 3] = 0.7, -0.2, 1.5
"""client_from_room of a client with another world."""
MARKER = Marker(id=7, side_m=0.5)
CUBE = shape_of(trimesh.creation.box((0.2, 0.2, 0.2)))


@pytest.fixture
def room(device: Device) -> Iterator[Room]:
    room = Room(device, wishes("given"), "study")
    yield room
    room.close()


def join(device: Device, room: Room, poses: str = "given", **said: object) -> ClientSession:
    asked = wishes(poses)
    return ClientSession(
        device, CAMERA, asked, room, Hello(client="test", camera=CAMERA, wishes=asked, room="study", **said)
    )


def said(matrix: Floats) -> tuple[float, ...]:
    return tuple(matrix.ravel().tolist())


def off(matrix: Floats, axis_angle: tuple[float, float, float], shift: tuple[float, float, float]) -> Floats:
    """`matrix` with an error."""
    error = np.eye(4)
    error[:3, :3] = cv2.Rodrigues(np.array(axis_angle))[0]
    error[:3, 3] = shift
    return matrix @ error


def scan(pipeline: ClientSession, steps: range, client_from_room: Floats | None = None) -> FrameResult:
    place = np.eye(4) if client_from_room is None else client_from_room
    for step in steps:
        result = pipeline.process(frame_at(view_at(step), step, given=place @ view_at(step)))
    return result


def lit(device: Device, parts: list[int], *, together: bool, light: Floats = LIGHT, **more: object) -> Light:
    """The light after frames of these planes, each by a client of its own, alone or in one room."""
    asked = structs.replace(corners.WISHES, **more)
    room = Room(device, asked, "corner") if together else None
    pipelines = {part: ClientSession(device, corners.CAMERA, asked, room) for part in sorted(set(parts))}
    for index, part in enumerate(parts):
        result = pipelines[part].process(corner_frame(part, index, light))
    for pipeline in pipelines.values():
        pipeline.close()
    if room:
        room.close()
    return result.light


@pytest.mark.parametrize(("part", "towards"), [(FLOOR, TOWARDS), (WALL, (0.5, 0.2, 0.8))])
def test_one_plane_says_that_it_does_not_know_the_direction(
    device: Device, part: int, towards: tuple[float, float, float]
) -> None:
    """Nor does it: a light from where none is expected is not found."""
    light = lit(device, [part] * 8, together=False, light=0.3 * lobe_and_sky(towards))
    assert not light.valid
    assert degrees_between(light.dominant_direction, towards) > 25


@pytest.mark.parametrize(("albedo", "most_deg"), [("estimated", 8.0), ("constant", 8.0)])
def test_two_clients_that_see_a_plane_each_know_the_light_together(
    device: Device, albedo: str, most_deg: float
) -> None:
    light = lit(device, [FLOOR, WALL] * 6, together=True, albedo=albedo)
    assert degrees_across(light.dominant_direction, TOWARDS) < most_deg


def test_cameras_of_several_sizes_add_to_one_light(device: Device) -> None:
    """Patches of the room are those of all."""
    small = structs.replace(corners.CAMERA, width=64, height=48, fx=50.0, fy=50.0, cx=31.5, cy=23.5)
    room = Room(device, corners.WISHES, "corner")
    clients = [ClientSession(device, camera, corners.WISHES, room) for camera in (corners.CAMERA, small)]
    for index in range(12):
        frame = corner_frame(index % 2, index, LIGHT)
        if index % 2:
            frame = RgbdFrame(index, index / 30, frame.color[::2, ::2], frame.depth[::2, ::2], frame.world_from_camera)
        result = clients[index % 2].process(frame)
    for client in clients:
        client.close()
    room.close()
    assert degrees_across(result.light.dominant_direction, TOWARDS) < 6  # seen: 3.1


def test_each_client_is_told_the_light_in_its_own_world(device: Device) -> None:
    room = Room(device, corners.WISHES, "corner")
    hello = Hello(client="test", camera=corners.CAMERA, room="corner", room_from_world=said(inverse_rigid(ELSEWHERE)))
    first = ClientSession(device, corners.CAMERA, corners.WISHES, room)
    second = ClientSession(device, corners.CAMERA, corners.WISHES, room, hello)
    ups = [None, None]
    for index in range(12):
        frame = corner_frame(index % 2, index, LIGHT)
        if index % 2:
            frame = RgbdFrame(index, index / 30, frame.color, frame.depth, ELSEWHERE @ frame.world_from_camera)
        result = (first, second)[index % 2].process(frame)
        ups[index % 2] = result.light.up
    for client in (first, second):
        client.close()
    room.close()
    assert ups[0] == pytest.approx(corners.WISHES.up)
    assert ups[1] == pytest.approx(ELSEWHERE[:3, :3] @ ups[0])
    np.testing.assert_allclose(result.world_from_camera, frame.world_from_camera, atol=1e-9)
    assert degrees_across(ELSEWHERE[:3, :3].T @ result.light.dominant_direction, TOWARDS) < 6  # seen: 2.8


def test_what_is_said_of_a_world_is_corrected_by_what_both_see(device: Device, room: Room) -> None:
    scan(join(device, room), range(12))
    wrong = off(inverse_rigid(ELSEWHERE), (0.0, 0.02, 0.01), (0.02, -0.03, 0.01))
    second = join(device, room, room_from_world=said(wrong))
    scan(second, range(6, 12), ELSEWHERE)
    found = second._alignment.room_from_client
    assert distance_between(found @ ELSEWHERE @ view_at(8), view_at(8)) < 0.25 * VOXEL_M
    assert angle_between(found, inverse_rigid(ELSEWHERE)) < np.radians(0.06)  # seen: 0.024 degrees


def test_a_client_that_contradicts_the_room_is_told_so_and_kept_out(device: Device, room: Room) -> None:
    first = join(device, room)
    scan(first, range(8))
    assert room.reconstruction.volume is not None
    before = room.reconstruction.volume.download_bricks()
    far_off = inverse_rigid(ELSEWHERE).copy()
    far_off[:3, 3] += 0.0, 0.0, -0.6
    second = join(device, room, room_from_world=said(far_off))
    result = scan(second, range(8, 11), ELSEWHERE)
    assert result.tracking == "lost"
    assert any(note.startswith("not aligned with the room, nothing is fused: ") for note in result.notes)
    after = room.reconstruction.volume.download_bricks()
    np.testing.assert_array_equal(after.tsdf, before.tsdf)
    assert scan(first, range(8, 10)).tracking == "given"


@pytest.mark.parametrize("poses", ["given", "track"])
def test_a_client_that_says_nothing_is_found_by_what_the_room_has_seen(device: Device, room: Room, poses: str) -> None:
    scan(join(device, room), range(0, 40, 2))
    second = join(device, room, poses)
    for step in range(14, 20):
        given = ELSEWHERE @ view_at(step) if poses == "given" else None
        result = second.process(frame_at(view_at(step), step, given=given))
        assert result.tracking == ("given" if poses == "given" else "tracked")
    found = second._alignment.room_from_client @ result.world_from_camera
    assert distance_between(found, view_at(19)) < 0.5 * VOXEL_M


def test_a_client_that_shows_nothing_of_the_room_is_kept_out_until_it_does(device: Device, room: Room) -> None:
    scan(join(device, room), range(10))
    assert room.reconstruction.volume is not None
    fused = room.reconstruction.volume.frames
    second = join(device, room)
    away = ELSEWHERE @ view_at(60)
    turned = view_at(60) @ np.diag([-1.0, 1.0, -1.0, 1.0])
    result = second.process(frame_at(turned, 0, given=away))
    assert result.tracking == "lost"
    assert room.reconstruction.volume.frames == fused
    assert scan(second, range(4, 7), ELSEWHERE).tracking == "given"


def show_marker(frame: RgbdFrame, view: Floats) -> RgbdFrame:
    """The frame with the marker on the wall before the camera's way, where nothing hides it."""
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50)
    sheet = np.pad(cv2.aruco.generateImageMarker(dictionary, MARKER.id, 240), 40, constant_values=255)
    half = MARKER.side_m / 2 * 320 / 240
    in_marker = np.array([[-half, half, 0, 1], [half, half, 0, 1], [half, -half, 0, 1], [-half, -half, 0, 1]])
    in_camera = in_marker @ (inverse_rigid(view) @ marker_place()).T
    pixels = in_camera[:, :2] / in_camera[:, 2:3] * [CAMERA.fx, CAMERA.fy] + [CAMERA.cx, CAMERA.cy]
    square = np.array([[0, 0], [320, 0], [320, 320], [0, 320]], np.float32) - 0.5
    fine = 8  # parts of a pixel, which is their mean
    warp = cv2.getPerspectiveTransform(square, (fine * (pixels + 0.5) - 0.5).astype(np.float32))
    size = (fine * CAMERA.width, fine * CAMERA.height)
    behind = cv2.resize(frame.color, size, interpolation=cv2.INTER_NEAREST)
    shown = cv2.warpPerspective(sheet, warp, size)[..., None]
    covered = cv2.warpPerspective(np.full_like(sheet, 255), warp, size, flags=cv2.INTER_NEAREST)[..., None] > 0
    mixed = np.where(covered, shown, behind).astype(np.uint8)
    color = cv2.resize(mixed, (CAMERA.width, CAMERA.height), interpolation=cv2.INTER_AREA)
    return RgbdFrame(frame.index, frame.timestamp_s, color, frame.depth, frame.world_from_camera)


def marker_place() -> Floats:
    """room_from_marker."""
    place = np.eye(4)
    place[:3, :3] = np.diag([1.0, -1.0, -1.0])  # y up on the sheet, z towards the camera
    place[:3, 3] = -0.1, 0.2, 2.5
    return place


def test_a_common_marker_lays_one_world_on_the_other(device: Device, room: Room) -> None:
    first, second = join(device, room, marker=MARKER), join(device, room, marker=MARKER)
    view = view_at(0)
    result = second.process(show_marker(frame_at(view, 0, given=ELSEWHERE @ view), view))
    assert result.tracking == "given"  # the first in the room: its world is the room's
    assert room.markers.place_of(MARKER) is not None
    for step in range(6):
        view = view_at(step)
        shown = first.process(show_marker(frame_at(view, step, given=view), view))
        assert shown.tracking == "given"
    found = first._alignment.room_from_client
    assert distance_between(found @ view, ELSEWHERE @ view) < 0.5 * VOXEL_M
    assert angle_between(found, ELSEWHERE) < np.radians(0.5)


def test_a_marker_that_nobody_has_seen_is_said(device: Device, room: Room) -> None:
    scan(join(device, room), range(3))
    result = scan(join(device, room, marker=MARKER), range(1), ELSEWHERE)
    assert result.tracking == "lost"
    assert any("nobody in the room has seen marker 7" in note for note in result.notes)


def test_a_frame_has_no_pose_before_its_marker_has_a_place(device: Device, room: Room) -> None:
    view = view_at(0)
    frame = replace(show_marker(frame_at(view, 0, given=view), view), world_from_camera=None)
    client = join(device, room, marker=MARKER)
    assert client._alignment.in_room(frame) is frame
    room.markers.note(MARKER, marker_place())
    found = client._alignment.in_room(frame).world_from_camera
    assert found is not None
    assert distance_between(found, view) < 0.4  # seen: 0.26 m, from a marker of a few pixels alone, 2.5 m away


def test_somebody_who_only_looks_sees_the_room_from_where_he_stands(device: Device, room: Room) -> None:
    scan(join(device, room), range(0, 30, 2))
    looker = join(device, room, room_from_world=said(inverse_rigid(ELSEWHERE)))
    looker.place_object("cube", CUBE, Placement(position_m=tuple((ELSEWHERE @ [-0.9, 0.6, 1.0, 1.0])[:3].tolist())))
    assert room.reconstruction.volume is not None
    fused = room.reconstruction.volume.frames
    seen = looker.process(Viewpoint(0, 0.0, ELSEWHERE @ view_at(13)))
    true = frame_at(view_at(13)).color.astype(int)
    near = np.abs(seen.color.astype(int) - true).max(axis=-1)
    assert seen.tracking == "given"
    assert np.median(near) < 3  # seen: 1
    assert (near > 60).mean() < 0.08  # the cube, and edges
    assert "rasterize" in seen.plan.run
    assert {left.effect for left in seen.plan.left_out} >= {"estimate_light"}
    assert room.reconstruction.volume.frames == fused
    np.testing.assert_allclose(seen.world_from_camera, ELSEWHERE @ view_at(13), atol=1e-9)


def test_a_camera_without_depth_gets_light_and_objects_and_changes_nothing(device: Device, room: Room) -> None:
    scan(join(device, room), range(12))
    plain = join(device, room, room_from_world=said(inverse_rigid(ELSEWHERE)))
    assert room.reconstruction.volume is not None
    before = room.reconstruction.volume.download_bricks()
    frame = frame_at(view_at(8), 8, given=ELSEWHERE @ view_at(8))
    frame = replace(frame, depth=np.zeros_like(frame.depth), has_depth=False)
    plain.place_object("cube", CUBE, Placement(position_m=tuple((ELSEWHERE @ [-0.9, 0.6, 1.0, 1.0])[:3].tolist())))
    result = plain.process(frame)
    assert result.tracking == "given"
    assert result.notes == ()
    assert (np.abs(result.color.astype(int) - frame.color).max(axis=-1) > 12).mean() > 0.03  # seen: 0.062
    np.testing.assert_array_equal(room.reconstruction.volume.download_bricks().tsdf, before.tsdf)


def test_without_depth_a_client_must_say_where_it_is(device: Device, room: Room) -> None:
    frame = replace(frame_at(view_at(8), 8, given=view_at(8)), has_depth=False)
    with pytest.raises(ValueError, match="nobody has scanned this room yet"):
        join(device, room).process(frame)
    with pytest.raises(ValueError, match="nobody has scanned this room yet"):
        join(device, room).process(Viewpoint(0, 0.0, view_at(0)))
    scan(join(device, room), range(2))
    result = join(device, room).process(frame)
    assert result.tracking == "lost"
    assert result.notes[0].startswith("not aligned with the room: without depth, say where")


def test_objects_of_one_client_are_seen_by_the_others_in_their_place(device: Device, room: Room) -> None:
    first = join(device, room)
    second = join(device, room, room_from_world=said(inverse_rigid(ELSEWHERE)))
    scan(first, range(4))
    scan(second, range(4, 6), ELSEWHERE)
    point = ELSEWHERE @ [-0.9, 0.6, 1.0, 1.0]
    second.place_object("cube", CUBE, Placement(position_m=tuple(point[:3].tolist())))
    frame = frame_at(view_at(6), 6, given=view_at(6))
    shown = first.process(frame).color
    changed = np.abs(shown.astype(int) - frame.color).max(axis=-1) > 12
    rows, columns = np.nonzero(changed)
    pixel = inverse_rigid(view_at(6)) @ [-0.9, 0.5, 1.0, 1.0]
    expected = pixel[:2] / pixel[2] * [CAMERA.fx, CAMERA.fy] + [CAMERA.cx, CAMERA.cy]
    assert np.hypot(np.median(columns) - expected[0], np.median(rows) - expected[1]) < 3  # seen: 1.03
    first.remove_object("cube")
    with pytest.raises(KeyError):
        second.remove_object("cube")


def test_a_view_at_rest_wakes_when_another_client_changes_the_room(device: Device) -> None:
    room = Room(device, structs.replace(wishes("given"), light=((0.5, 0.5, 0.5),)), "study")
    first, second = join(device, room), join(device, room)
    still = frame_at(view_at(0), 0, given=view_at(0))
    second.process(still)
    for _ in range(40):
        result = first.process(still)
    assert any(left.effect == "estimate_light" for left in result.plan.left_out)
    second.place_object("cube", CUBE, Placement(position_m=(-0.9, 0.6, 1.0)))
    woken = first.process(still)
    assert "rasterize" in woken.plan.run
    room.close()


def test_wishes_that_are_one_for_all_are_the_first_clients_and_the_others_are_told(device: Device, room: Room) -> None:
    scan(join(device, room), range(2))
    asked = structs.replace(wishes("given"), bands=3, albedo="estimated")
    hello = Hello(client="test", camera=CAMERA, wishes=asked, room="study", room_from_world=said(np.eye(4)))
    result = scan(ClientSession(device, CAMERA, asked, room, hello), range(2, 3))
    for name in ("bands", "albedo"):
        assert f"{name} is as the client that opened room 'study' asked" in result.notes


def test_a_shared_volume_reaches_beyond_what_its_first_client_sees(device: Device) -> None:
    asked = structs.replace(wishes("given"), volume_m=None)
    room = Room(device, asked, "hall")
    scan(ClientSession(device, CAMERA, asked, room), range(1))
    volume = room.reconstruction.volume
    assert volume is not None
    size = volume.voxel_m * 8 * np.array(volume.bricks)
    assert (size > np.array(BOUNDS[3:]) - BOUNDS[:3]).all()
    room.close()


def test_clients_of_threads_of_their_own_do_not_disturb_one_another(device: Device, room: Room) -> None:
    results: dict[int, FrameResult] = {}

    def work(number: int) -> None:
        pipeline = join(device, room, room_from_world=said(np.eye(4)))
        results[number] = scan(pipeline, range(number, number + 6))
        pipeline.close()

    threads = [threading.Thread(target=work, args=(number,)) for number in range(3)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert [results[number].tracking for number in range(3)] == ["given"] * 3
    assert room.reconstruction.volume is not None
    assert room.reconstruction.volume.frames == 18


def test_a_room_of_a_client_whose_preset_is_chosen_for_it_opens(device: Device) -> None:
    """Where transfer is sampled is each client's own, and not known yet when the room is opened."""
    room = Room(device, structs.replace(wishes("given"), preset="auto", budget_ms=100.0), "study")
    assert scan(join(device, room), range(1)).tracking == "given"
    room.close()
