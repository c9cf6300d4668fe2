"""Where objects were moved to is on the disk before the next save, and belongs to the one that it follows."""

from __future__ import annotations

import logging
import shutil
import threading
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import msgspec
import pytest

from server.opencl.device import Device
from server.room.room import Room
from server.scene.placement import Placement
from server.service.saving.checksummed_files import read_parts, write_parts
from server.service.saving.room_store import RoomStore, RoomStoreError, folder_name
from tests.scenes.faulty_disk import FaultyDisk, PowerCut, full
from tests.scenes.kept_rooms import CUBE, PLACE, client_of, found, print_of, scan
from tests.scenes.rooms import wishes

PATIENCE_S = 20.0


@pytest.fixture
def room(device: Device) -> Iterator[Room]:
    room = Room(device, wishes("given"), "study")
    room.key_digest = b"digest"
    client = client_of(device, room, wishes("given"))
    client.place_object("cube", CUBE, PLACE)
    client.place_object("other", CUBE, PLACE)
    scan(client, range(1))
    yield room
    room.close()


@pytest.fixture
def store(tmp_path: Path, room: Room) -> RoomStore:
    """With one save of it."""
    store = RoomStore(tmp_path)
    store.save(room)
    return store


def move(room: Room, x_m: float) -> tuple[str, ...]:
    """The room's print then."""
    room.objects.move("cube", Placement(position_m=(x_m, 0.5, 1.0)))
    return print_of(room)


def written(folder: Path) -> dict[str, int]:
    """When each file was written, but for that of the moves."""
    return {str(path): path.stat().st_mtime_ns for path in folder.rglob("*") if path.is_file() and path.name != "moves"}


def test_a_move_is_found_and_nothing_else_is_written(
    device: Device, room: Room, store: RoomStore, tmp_path: Path
) -> None:
    before = written(tmp_path)
    for x_m in (0.1, 0.2):
        moved = move(room, x_m)
        store.save_placements(room)
        assert found(tmp_path, device) == moved
    assert written(tmp_path) == before
    assert (tmp_path / folder_name("study") / "moves").stat().st_size < 2000


def test_moves_go_on_from_where_they_were_found(device: Device, room: Room, store: RoomStore, tmp_path: Path) -> None:
    move(room, 0.1)
    store.save_placements(room)
    again, later = RoomStore(tmp_path), None
    for x_m in (0.2, 0.3, 0.4):  # each by a server that was started anew
        later = again.load("study", device)
        assert later is not None
        moved = move(later, x_m)
        again.save_placements(later)
        later.close()
        again = RoomStore(tmp_path)
        assert found(tmp_path, device) == moved


def test_a_save_that_comes_later_is_what_counts(device: Device, room: Room, store: RoomStore, tmp_path: Path) -> None:
    move(room, 0.1)
    store.save_placements(room)
    later = move(room, 0.2)  # not acknowledged, but in the save
    store.save(room)
    assert found(tmp_path, device) == later


def test_what_is_more_than_a_move_is_saved_whole(device: Device, room: Room, store: RoomStore, tmp_path: Path) -> None:
    room.objects.place("cube", replace(CUBE, notes=("another",)), PLACE)
    placed = move(room, 0.3)
    store.save_placements(room)
    assert found(tmp_path, device) == placed
    room.objects.remove("other")
    removed = move(room, 0.4)
    store.save_placements(room)
    assert found(tmp_path, device) == removed


def test_a_move_waits_neither_for_a_frame_nor_for_a_save(room: Room, store: RoomStore) -> None:
    move(room, 0.1)
    saves = store._saves("study")
    with room.lock, saves.lock:
        saving = threading.Thread(target=store.save_placements, args=(room,))
        saving.start()
        saving.join(PATIENCE_S)
        assert not saving.is_alive()


def test_moves_before_the_first_save_of_a_room_are_kept(device: Device, tmp_path: Path) -> None:
    room = Room(device, wishes("given"), "study")
    room.objects.place("cube", CUBE, PLACE)
    moved = move(room, 0.1)
    RoomStore(tmp_path).save_placements(room)
    assert found(tmp_path, device) == moved
    room.close()


def test_moves_of_a_save_that_is_damaged_are_not_those_of_the_one_before(
    device: Device, room: Room, store: RoomStore, tmp_path: Path
) -> None:
    before = print_of(room)
    room.objects.place("cube", replace(CUBE, notes=("another",)), PLACE)
    store.save(room)
    move(room, 0.3)
    store.save_placements(room)
    newest = tmp_path / folder_name("study") / "1" / "save"
    newest.write_bytes(newest.read_bytes()[:-1])
    assert found(tmp_path, device) == before
    again = RoomStore(tmp_path)
    loaded = again.load("study", device)
    assert loaded is not None
    for x_m in (0.5, 0.6):  # nor of those that come after
        loaded.objects.place("cube", CUBE, Placement(position_m=(x_m, 0.0, 1.0)))
        again.save(loaded)
        assert found(tmp_path, device) == print_of(loaded)
    loaded.close()


def test_after_a_power_cut_the_object_is_where_it_was_or_where_it_was_moved_to(
    device: Device, room: Room, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    disk = FaultyDisk(monkeypatch)
    step, seen, was_cut = 1, [], True
    while was_cut:
        folder = tmp_path / f"cut-{step}"
        store = RoomStore(folder)
        store.save(room)
        prints = [move(room, 0.1 + step)]
        store.save_placements(room)
        prints.append(move(room, 0.5 + step))
        disk.fail_at(step, PowerCut())
        try:
            store.save_placements(room)
            was_cut = False
        except PowerCut:
            disk.cut()
        disk.fails_at = 0
        seen.append(prints.index(found(folder, device)))
        shutil.rmtree(folder)
        step += 1
    assert seen == sorted(seen)
    assert set(seen) == {0, 1}
    assert len(seen) > 4


def test_a_full_disk_is_told_and_tried_again(
    device: Device, room: Room, store: RoomStore, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    disk = FaultyDisk(monkeypatch)
    disk.only_writes = True
    before, moved = print_of(room), move(room, 0.1)
    disk.fail_at(2, full())
    with pytest.raises(RoomStoreError, match="moved in room 'study' was not saved, it goes on in memory: No space"):
        store.save_placements(room)
    disk.fails_at = 0
    assert found(tmp_path, device) == before
    store.save_placements(room)
    assert found(tmp_path, device) == moved


def test_damaged_moves_are_told_and_the_save_counts(
    device: Device, room: Room, store: RoomStore, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    before = print_of(room)
    move(room, 0.1)
    store.save_placements(room)
    path = tmp_path / folder_name("study") / "moves"
    path.write_bytes(path.read_bytes()[:-3])
    with caplog.at_level(logging.WARNING):
        assert found(tmp_path, device) == before
    (record,) = caplog.records
    assert record.getMessage().startswith("objects of room 'study' are where they were some seconds before: ")
    moved = move(room, 0.2)
    store.save_placements(room)
    assert found(tmp_path, device) == moved


def as_before(folder: Path) -> None:
    """Make the saves those of a program that knew of no moves, and put no key into the header."""
    for path in folder.glob("*/[01]/save"):
        header, state = read_parts(path)
        fields = msgspec.msgpack.decode(header)
        earlier = {name: fields[name] for name in ("version", "name", "sequence")}
        assert len(fields) > len(earlier)
        write_parts(path, [msgspec.msgpack.encode(earlier), state])


@pytest.mark.usefixtures("store")
def test_a_room_that_was_saved_by_the_version_before_is_loaded(device: Device, room: Room, tmp_path: Path) -> None:
    as_before(tmp_path)
    assert RoomStore(tmp_path).key_digest("study") == b"digest"
    assert found(tmp_path, device) == print_of(room)
    again = RoomStore(tmp_path)
    loaded = again.load("study", device)
    assert loaded is not None
    moved = move(loaded, 0.4)
    again.save_placements(loaded)
    loaded.close()
    assert found(tmp_path, device) == moved


@pytest.mark.usefixtures("store")
def test_the_key_is_told_by_the_save_alone(tmp_path: Path) -> None:
    assert RoomStore(tmp_path).key_digest("study") == b"digest"
    assert RoomStore(tmp_path).key_digest("elsewhere") is None
    own = tmp_path / folder_name("study")
    for path in own.rglob("*"):
        if path.is_file() and path.name != "save":
            path.unlink()
    assert RoomStore(tmp_path).key_digest("study") == b"digest"
    (own / "0" / "save").write_bytes(b"damaged")
    assert RoomStore(tmp_path).key_digest("study") is None  # loading will tell
