"""Rooms saved and loaded: nothing is lost, and what comes back goes on."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from dataclasses import astuple
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from msgspec import structs

from protocol.frames import RgbdFrame
from protocol.messages import Light, Marker
from server.client_session import ClientSession
from server.input.measure import GREATEST_DEPTH_M
from server.maths.registration import distance_between
from server.opencl.device import Device
from server.opencl.engine import Engine
from server.pipeline import FrameResult
from server.room.room import Room
from server.room.room_objects import ObjectRecord
from server.scene.placement import Placement
from server.service.saving.brick_files import merged, read_bricks, write_bricks
from server.service.saving.room_store import RoomStore, folder_name
from server.volume.raycast import raycast
from server.volume.volume import Volume
from tests.scenes import corners
from tests.scenes.analytic import Floats, look_at
from tests.scenes.corners import FLOOR, WALL, corner_frame, degrees_across
from tests.scenes.kept_rooms import BALL, CUBE, PLACE, client_of, print_of, scan, voxels_of
from tests.scenes.lights import lobe_and_sky
from tests.scenes.rooms import CAMERA, VOXEL_M, frame_at, view_at, wishes
from tests.scenes.volumes import fuse_frame

TOWARDS = (0.5, 0.8, 0.0)
LIGHT = 0.3 * lobe_and_sky(TOWARDS)
ELSEWHERE = np.eye(4)
ELSEWHERE[:3, :3] = cv2.Rodrigues(np.array([0.2, 1.1, -0.3]))[0]
ELSEWHERE[:3, 3] = 0.7, -0.2, 1.5


@pytest.fixture
def store(tmp_path: Path) -> RoomStore:
    return RoomStore(tmp_path / "rooms")


@pytest.fixture
def room(device: Device) -> Iterator[Room]:
    room = Room(device, wishes("given"), "study")
    yield room
    room.close()


def loaded(store: RoomStore, name: str, device: Device) -> Room:
    """As a server finds it that was started anew."""
    room = RoomStore(store._folder).load(name, device)
    assert room is not None
    return room


def test_a_room_comes_back_bit_for_bit(device: Device, room: Room, store: RoomStore) -> None:
    client = client_of(device, room, wishes("given"))
    client.place_object("early", CUBE, PLACE)
    scan(client, range(0, 20, 2))
    client.place_object("ball", BALL, Placement(position_m=(-1.2, 0.5, 1.1), scale=2.0, yaw_deg=30))
    client.place_object("as it is", CUBE, Placement())
    room.markers.note(Marker(id=3, side_m=0.1), ELSEWHERE)
    saved = store.save(room)
    again = loaded(store, "study", device)
    assert print_of(again) == print_of(room)
    assert again.wishes == room.wishes
    assert [kept.object_id for kept in again.objects.kept()] == ["early", "ball", "as it is"]
    assert len(again.reconstruction.keyframes) == len(room.reconstruction.keyframes) > 0
    assert again.reconstruction.usual_exposure == room.reconstruction.usual_exposure
    assert saved.bricks == room.reconstruction.volume.allocated_bricks
    for step in (3, 11):
        pictures = [
            raycast(one.engine, CAMERA, volume.volume_from_world() @ view_at(step), volume)
            for one in (room, again)
            for volume in [one.reconstruction.volume]
        ]
        for name in ("positions", "normals"):
            of_room, of_again = (getattr(picture, name).get() for picture in pictures)
            assert of_room.tobytes() == of_again.tobytes()
    again.close()


def test_a_moved_object_stands_where_it_was_moved_to(device: Device, room: Room, store: RoomStore) -> None:
    client = client_of(device, room, wishes("given"))
    client.place_object("cube", CUBE, PLACE)
    scan(client, range(1))
    store.save(room)
    client.move_object("cube", Placement(position_m=(-0.9, 0.6, 1.0000001)))
    assert store.save(room).written_bytes > 0
    again = loaded(store, "study", device)
    assert print_of(again) == print_of(room)
    again.close()


def test_a_room_without_a_frame_keeps_what_waits_for_one(device: Device, room: Room, store: RoomStore) -> None:
    client_of(device, room, wishes("given")).place_object("cube", CUBE, PLACE)
    store.save(room)
    again = loaded(store, "study", device)
    assert again.reconstruction.volume is None
    assert print_of(again) == print_of(room)
    scan(client_of(device, again, wishes("given")), range(1))
    assert len(again.objects.placed(np.eye(4))) == 1
    again.close()


@pytest.mark.parametrize("poses", ["given", "track"])
def test_a_client_goes_on_in_a_room_that_came_back(device: Device, room: Room, store: RoomStore, poses: str) -> None:
    scan(client_of(device, room, wishes("given")), range(0, 40, 2))
    store.save(room)
    again = loaded(store, "study", device)
    fused = again.reconstruction.volume.frames
    client = client_of(device, again, wishes(poses))
    for step in range(14, 19):
        given = ELSEWHERE @ view_at(step) if poses == "given" else None
        result = client.process(frame_at(view_at(step), step, given=given))
        assert result.tracking == ("given" if poses == "given" else "tracked")
    found = client._alignment.room_from_client @ result.world_from_camera
    assert distance_between(found, view_at(18)) < 0.5 * VOXEL_M
    assert again.reconstruction.volume.frames == fused + 5
    again.close()


def test_a_room_that_came_back_fuses_as_if_nothing_had_been(device: Device, room: Room, store: RoomStore) -> None:
    """And estimates its light so, where that is by sums over frames."""
    client = client_of(device, room, wishes("given", exposure="constant"))
    scan(client, range(8))
    store.save(room)
    again = loaded(store, "study", device)
    other = client_of(device, again, wishes("given", exposure="constant"), room_from_world=tuple(np.eye(4).ravel()))
    other._alignment._is_first = True  # the client that was there before
    scan(client, range(8, 12))
    scan(other, range(8, 12))
    assert voxels_of(again.reconstruction.volume) == voxels_of(room.reconstruction.volume)
    np.testing.assert_array_equal(again.light.estimate().sh, room.light.estimate().sh)
    np.testing.assert_array_equal(again.light.estimate().std, room.light.estimate().std)
    again.close()


CORNER = structs.replace(corners.WISHES, exposure="constant")


def show(client: ClientSession, parts: list[int], first: int, light: Floats = LIGHT) -> Light:
    """The light after frames of these planes of a corner."""
    for index, part in enumerate(parts, start=first):
        result = client.process(corner_frame(part, index, light))
    return result.light


@pytest.fixture
def corner(device: Device) -> Iterator[Room]:
    """A room whose light two planes have told."""
    room = Room(device, CORNER, "corner")
    light = show(ClientSession(device, corners.CAMERA, CORNER, room), [FLOOR, WALL] * 6, 0)
    assert light.spread_deg is not None
    assert light.spread_deg < 60  # seen: 49
    assert degrees_across(light.dominant_direction, TOWARDS) < 8  # seen: 4.1
    yield room
    room.close()


def test_what_two_planes_told_holds_for_one(device: Device, corner: Room, store: RoomStore) -> None:
    """One plane alone does not say where light comes from; what two said before still counts."""
    told = corner.light.estimate()
    store.save(corner)
    again = loaded(store, "corner", device)
    assert again.light.estimate().sh.tobytes() == told.sh.tobytes()
    went_on, came_back = (
        ClientSession(device, corners.CAMERA, CORNER, corner),
        ClientSession(device, corners.CAMERA, CORNER, again),
    )
    lights = [show(client, [FLOOR] * 4, 12) for client in (went_on, came_back)]
    assert degrees_across(lights[1].dominant_direction, lights[0].dominant_direction) < 5
    assert degrees_across(lights[1].dominant_direction, TOWARDS) < 8
    again.close()


def test_a_light_that_has_changed_is_found_in_a_room_that_came_back(
    device: Device, corner: Room, store: RoomStore
) -> None:
    store.save(corner)
    again = loaded(store, "corner", device)
    client, turned = ClientSession(device, corners.CAMERA, CORNER, again), (0.98, 0.2, 0.0)
    light = show(client, [FLOOR, WALL] * 8, 12, 0.3 * lobe_and_sky(turned))
    assert degrees_across(light.dominant_direction, turned) < 12  # 47 before; seen: 9, after other frames 5 to 10
    again.close()


def test_changes_behind_the_farthest_surface_that_is_fused_are_told(engine: Engine) -> None:
    """A brick's corner there is not in view as its middle is, but integration reaches it."""
    depth = np.full((CAMERA.height, CAMERA.width), int(1000 * GREATEST_DEPTH_M) - 1, np.uint16)
    view = look_at((0, 0, 0), (1, 1, 1))
    frame = RgbdFrame(0, 0.0, np.full((*depth.shape, 3), 128, np.uint8), depth, view)
    corner = (GREATEST_DEPTH_M + 0.3) / np.sqrt(3)
    volume = Volume(engine, (corner - 1.6,) * 3 + (corner + 1.6,) * 3, 0.1)
    for _ in range(2):
        before, bits = volume.changes, voxels_of(volume)
        fuse_frame(engine, volume, CAMERA, frame)
        after = voxels_of(volume)
        differing = {place for place in after if after[place] != bits.get(place)}
        assert 2 + 4 * (2 + 4 * 2) in differing  # that brick, x fastest
        assert differing <= set(volume.changed_since(before).tolist())


def test_what_the_light_is_estimated_from_is_kept(device: Device, corner: Room, store: RoomStore) -> None:
    """Patches and shell, to the bit; the light told is the last one until a new frame comes."""
    store.save(corner)
    again = loaded(store, "corner", device)
    before, after = corner.light.known().room, again.light.known().room
    assert before is not None
    assert after is not None
    assert len(before.patches.keys) > 50
    for one, other in zip(astuple(before.patches), astuple(after.patches), strict=True):
        np.testing.assert_array_equal(other, one)
    assert after.shell is not None
    assert before.shell is not None
    np.testing.assert_array_equal(after.shell.low, before.shell.low)
    np.testing.assert_array_equal(again.light.estimate().sh, corner.light.estimate().sh)
    again.close()


def test_a_light_that_was_given_stays_so(device: Device, store: RoomStore) -> None:
    asked = structs.replace(wishes("given"), light=((0.5, 0.4, 0.3),))
    room = Room(device, asked, "study")
    scan(client_of(device, room, asked), range(1))
    store.save(room)
    again = loaded(store, "study", device)
    assert again.light.is_given
    np.testing.assert_array_equal(again.light.estimate().sh, room.light.estimate().sh)
    again.close()
    room.close()


def test_only_what_has_changed_is_written(device: Device, room: Room, store: RoomStore) -> None:
    client = client_of(device, room, wishes("given"))
    scan(client, range(0, 60, 3))
    first = store.save(room)
    assert store.save(room).written_bytes == 0
    assert first.bricks == len(room.reconstruction.volume.places())
    turned = view_at(60) @ np.diag([-1.0, 1.0, -1.0, 1.0])
    scan(client, range(60, 61))
    for step in range(2):
        store.save(room)
        client.process(frame_at(turned, 61 + step, given=turned))
    later = store.save(room)
    assert 0 < later.bricks < first.bricks
    again = loaded(store, "study", device)
    assert print_of(again) == print_of(room)
    again.close()


def test_many_saves_take_no_more_room_than_two_and_a_few(device: Device, room: Room, store: RoomStore) -> None:
    client = client_of(device, room, wishes("given"))
    sizes = []
    for step in range(24):
        scan(client, range(step, step + 1))
        store.save(room)
        files = [path for path in store._folder.rglob("*") if path.is_file()]
        sizes.append(sum(len(places) for path in files if "bricks" in path.name for places, _, _ in read_bricks(path)))
    assert max(sizes) < 2 * (2 * len(room.reconstruction.volume.places()) + 1024)
    again = loaded(store, "study", device)
    assert print_of(again) == print_of(room)
    again.close()


def test_files_of_bricks_are_merged_with_the_last_of_each(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)

    def batch(*places: int):  # type: ignore[no-untyped-def]
        voxels = rng.random((len(places), 1024), np.float32).view(np.dtype([("x", np.float32), ("y", np.float32)]))
        return np.array(places, np.int32), voxels, rng.integers(0, 1 << 32, (len(places), 512), np.uint32)

    batches = [batch(3, 5, 9), batch(5, 11), batch(9)]
    paths = [tmp_path / f"bricks-{k}" for k in range(3)]
    for path, some in zip(paths, batches, strict=True):
        write_bricks(path, [some])
    found = {
        place: voxel.tobytes() + color.tobytes()
        for places, voxels, colors in merged(paths, np.array([3, 5, 9], np.int32))
        for place, voxel, color in zip(places.tolist(), voxels, colors, strict=True)
    }
    expected = {3: (0, 0), 5: (1, 0), 9: (2, 0)}
    assert found == {p: batches[b][1][r].tobytes() + batches[b][2][r].tobytes() for p, (b, r) in expected.items()}


def test_a_volume_fills_one_with_less_memory(device: Device, room: Room) -> None:
    scan(client_of(device, room, wishes("given")), range(0, 20, 2))
    volume = room.reconstruction.volume
    engine = Engine(device)
    small = Volume(engine, volume.bounds_m, volume.voxel_m, budget_bytes=volume.allocated_bricks * 6208 // 3)
    small.fill(volume.copies(volume.places()), volume.frames)
    assert 0 < small.allocated_bricks < volume.allocated_bricks
    assert voxels_of(small) == voxels_of(volume)
    np.testing.assert_array_equal(small.solid.get(), volume.solid.get())
    engine.close()


def test_a_save_is_of_one_moment(device: Device, room: Room, store: RoomStore, monkeypatch: pytest.MonkeyPatch) -> None:
    """Frames go on meanwhile: what is found in the save is what the room had between two of them."""
    client = client_of(device, room, wishes("given"))
    scan(client, range(2))
    had = {2: print_of(room)}
    process, sample, came, stop = (
        client._pipeline.process_frame,
        client._pipeline._sample_transfer,
        threading.Event(),
        threading.Event(),
    )

    def noted(*given: Any, **named: Any) -> FrameResult:
        result = process(*given, **named)
        had[room.reconstruction.volume.frames] = print_of(room)
        return result

    def in_the_middle(*given: Any) -> Any:
        came.set()  # fused, but the light is not estimated yet
        return sample(*given)

    def work() -> None:
        for step in range(2, 1000):
            if stop.is_set():
                return
            scan(client, range(step, step + 1))

    monkeypatch.setattr(client._pipeline, "process_frame", noted)
    monkeypatch.setattr(client._pipeline, "_sample_transfer", in_the_middle)
    thread, found = threading.Thread(target=work), []
    thread.start()
    try:
        for _ in range(4):
            came.clear()
            assert came.wait(60)
            store.save(room)
            found.append(loaded(store, "study", device))
    finally:
        stop.set()
        thread.join()
    for again in found:
        assert print_of(again) == had[again.reconstruction.volume.frames]
        again.close()
    assert len({again.reconstruction.volume.frames for again in found}) > 1


NAMES = [
    "study",
    "Study",
    "study ",
    "../../etc",
    "..",
    ".",
    "a/b",
    "a\\b",
    "C:",
    "nul",
    "Küche",
    "客間",
    "\n",
    "\0",
    "0",
]
NAMES += ["x" * 64, "🛋" * 64, "set-aside-1", "forgotten-x", ".forgotten-x"]


def test_names_stay_apart_and_inside_the_folder(device: Device, store: RoomStore, tmp_path: Path) -> None:
    for name in NAMES:
        room = Room(device, wishes("given"), name)
        room.objects.restore(ObjectRecord("cube", CUBE, PLACE))
        store.save(room)
        room.close()
    assert store.names() == tuple(sorted(NAMES))
    assert len({folder_name(name) for name in NAMES}) == len(NAMES)
    assert {path.name for path in tmp_path.iterdir()} == {"rooms"}
    assert {path.name for path in (tmp_path / "rooms").iterdir()} == {folder_name(name) for name in NAMES}
    store.delete("../../etc")
    assert store.load("../../etc", device) is None
    assert "../../etc" not in store.names()
    assert len(store.names()) == len(NAMES) - 1
    store.delete("never there")


def test_a_room_of_one_session_is_not_saved(device: Device, store: RoomStore) -> None:
    room = Room(device, wishes("given"))
    with pytest.raises(ValueError, match="without a name"):
        store.save(room)
    room.close()


def test_nothing_is_there_at_first(device: Device, store: RoomStore) -> None:
    assert store.names() == ()
    assert store.load("study", device) is None


def test_where_the_volume_is_seen_from_elsewhere(device: Device, room: Room) -> None:
    """Changes are told by where pictures were taken: bricks out of sight have none."""
    client = client_of(device, room, wishes("given"))
    scan(client, range(3))
    volume = room.reconstruction.volume
    before, bits = volume.changes, voxels_of(volume)
    away = view_at(0) @ np.diag([-1.0, 1.0, -1.0, 1.0])
    client.process(frame_at(away, 4, given=away))
    changed, after = set(volume.changed_since(before).tolist()), voxels_of(volume)
    assert {place for place in after if after[place] != bits.get(place)} <= changed
    assert len(changed) < len(after)
