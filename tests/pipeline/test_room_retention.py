"""Rooms on disk are limited by age and space: the oldest go first, none that is in use, each is told."""

from __future__ import annotations

import logging
import os
import threading
from pathlib import Path

import pytest

from server.opencl.device import Device
from server.room.room import Room
from server.service.room_saver import RoomSaver
from server.service.room_store import RoomStore, folder_name
from server.service.saving.retention import DAY_S, RetentionLimits
from tests.scenes.rooms import wishes

NOW_S = 2.0e9
"""Seconds since 1970."""


def save_room(store: RoomStore, device: Device, name: str, used_days_ago: float, padding_bytes: int = 0) -> Path:
    """Its folder, as if it had been closed then."""
    room = Room(device, wishes("given"), name)
    store.save(room)
    room.close()
    store.release(name)
    folder = store._folder / folder_name(name)
    (folder / "0" / "padding").write_bytes(bytes(padding_bytes))
    make_old(folder, used_days_ago)
    return folder


def make_old(folder: Path, days: float) -> None:
    for path in (*folder.rglob("*"), folder):
        os.utime(path, (NOW_S - days * DAY_S,) * 2)


@pytest.fixture
def store(tmp_path: Path) -> RoomStore:
    return RoomStore(tmp_path)


def test_rooms_that_nobody_has_used_for_long_go(
    device: Device, store: RoomStore, caplog: pytest.LogCaptureFixture
) -> None:
    save_room(store, device, "old", 31)
    young = save_room(store, device, "young", 29)
    with caplog.at_level(logging.WARNING):
        kept = store.enforce_limits(RetentionLimits(age_s=30 * DAY_S), NOW_S)
    assert store.names() == ("young",)
    assert [r.getMessage() for r in caplog.records] == ["room 'old' is removed from the disk: not used for 31 days"]
    assert (kept.rooms, kept.removed) == (1, 1)
    assert kept.space_bytes == sum(path.stat().st_size for path in young.rglob("*") if path.is_file())
    assert {path.name for path in store._folder.iterdir()} == {young.name}


def test_where_they_take_too_much_the_oldest_go_first(
    device: Device, store: RoomStore, caplog: pytest.LogCaptureFixture
) -> None:
    for days, name in enumerate(("d", "a", "c", "b"), start=1):
        save_room(store, device, name, days, padding_bytes=1 << 20)
    with caplog.at_level(logging.WARNING):
        kept = store.enforce_limits(RetentionLimits(space_bytes=5 << 19), NOW_S)
    assert store.names() == ("a", "d")
    assert [r.getMessage().partition(" is")[0] for r in caplog.records] == ["room 'b'", "room 'c'"]
    assert "rooms take 4 MiB, more than 2" in caplog.text
    assert kept.space_bytes < 5 << 19
    caplog.clear()
    assert store.enforce_limits(RetentionLimits(space_bytes=5 << 19), NOW_S) == kept
    assert not caplog.records


def test_no_room_that_is_in_use_goes(device: Device, store: RoomStore) -> None:
    open_here, elsewhere = save_room(store, device, "open", 40), save_room(store, device, "elsewhere", 0.001)
    room = store.load("open", device)
    assert room is not None
    everything = RetentionLimits(space_bytes=0, age_s=0.0)
    kept = store.enforce_limits(everything, NOW_S)
    assert (kept.rooms, kept.removed) == (2, 0)
    assert open_here.exists()
    assert elsewhere.exists()  # another process may be at work on it: it was used a minute ago
    store.release("open")
    room.close()
    make_old(open_here, 1)
    make_old(elsewhere, 1)
    assert store.enforce_limits(everything, NOW_S).rooms == 0


def test_a_room_at_work_says_so_on_the_disk(device: Device, store: RoomStore) -> None:
    """For another process on the same folder, also where nothing changes."""
    folder = save_room(store, device, "study", 40)
    room = store.load("study", device)
    assert room is not None
    store.save(room)
    make_old(folder, 40)
    store._saves("study")._noted_s = float("-inf")  # a minute later
    assert store.save(room).written_bytes == 0
    room.close()
    assert RoomStore(store._folder).enforce_limits(RetentionLimits(age_s=DAY_S)).rooms == 1


def test_damaged_saves_go_before_rooms(device: Device, store: RoomStore, caplog: pytest.LogCaptureFixture) -> None:
    folder = save_room(store, device, "study", 3)
    for name in ("set-aside-1", "set-aside-2"):
        (folder / name).mkdir()
        (folder / name / "save").write_bytes(bytes(1 << 20))
        make_old(folder / name, 2)
    make_old(folder / "set-aside-1", 50)
    with caplog.at_level(logging.WARNING):
        store.enforce_limits(RetentionLimits(age_s=30 * DAY_S), NOW_S)
        assert "a damaged save of room 'study', set-aside-1, is removed from the disk: not used" in caplog.text
        assert (folder / "set-aside-2").exists()
        store.enforce_limits(RetentionLimits(space_bytes=1 << 19), NOW_S)
    assert not (folder / "set-aside-2").exists()
    assert store.names() == ("study",)


def test_what_a_crash_left_of_a_removal_is_removed(device: Device, store: RoomStore) -> None:
    (store._folder / ".forgotten-study").mkdir()
    (store._folder / ".forgotten-study" / "save").write_bytes(b"x")
    save_room(store, device, "old", 31)
    assert store.enforce_limits(RetentionLimits(age_s=30 * DAY_S), NOW_S).space_bytes == 0
    assert not list(store._folder.iterdir())


def test_without_limits_nothing_goes(device: Device, store: RoomStore) -> None:
    save_room(store, device, "old", 10_000)
    assert store.enforce_limits(RetentionLimits(), NOW_S).rooms == 1


def test_the_saver_sees_to_it(store: RoomStore) -> None:
    tidied = threading.Event()
    saver = RoomSaver(store, lambda: [], every_s=0.01, enforce_limits=tidied.set)
    saver.start()
    assert tidied.wait(20)
    saver.stop()
