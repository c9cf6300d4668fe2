"""Rooms on disk are limited by age and space: the oldest go first, none that is in use, each is told."""

from __future__ import annotations

import logging
import os
import threading
import time
from pathlib import Path

import pytest

from server.opencl.device import Device
from server.room.room import Room
from server.room.room_objects import ObjectRecord
from server.service.saving.retention import DAY_S, RetentionLimits
from server.service.saving.room_saver import RoomSaver
from server.service.saving.room_store import RoomStore, folder_name
from tests.scenes.kept_rooms import CUBE, PLACE
from tests.scenes.rooms import wishes

LONG_AGO_S = 1.0e9
"""Seconds since 1970; of the system's clock."""


class Clock:
    """A clock that is never set; seconds."""

    now_s = 5.0

    def __call__(self) -> float:
        return self.now_s


def save_room(store: RoomStore, device: Device, name: str, padding_bytes: int = 0) -> Path:
    """Its folder; opened and closed again."""
    room = Room(device, wishes("given"), name)
    room.objects.restore(ObjectRecord("cube", CUBE, PLACE))
    store.save(room)
    room.close()
    store.release(name)
    folder = store._folder / folder_name(name)
    (folder / "0" / "padding").write_bytes(bytes(padding_bytes))
    return folder


def stamp(folder: Path, at_s: float) -> None:
    """As if it had been written then; Unix time."""
    for path in (*folder.rglob("*"), folder):
        os.utime(path, (at_s, at_s))


@pytest.fixture
def clock() -> Clock:
    return Clock()


@pytest.fixture
def store(tmp_path: Path, clock: Clock) -> RoomStore:
    return RoomStore(tmp_path, clock)


def pass_days(store: RoomStore, clock: Clock, days: float) -> None:
    """The store looks at its rooms, and then not for so long."""
    store.enforce_limits(RetentionLimits())
    clock.now_s += days * DAY_S


def rooms_in(store: RoomStore) -> set[str]:
    return {path.name for path in store._folder.iterdir() if path.is_dir()}


def test_rooms_that_nobody_has_used_for_long_go(
    device: Device, store: RoomStore, clock: Clock, caplog: pytest.LogCaptureFixture
) -> None:
    save_room(store, device, "old")
    pass_days(store, clock, 2)
    young = save_room(store, device, "young")
    pass_days(store, clock, 29)
    with caplog.at_level(logging.WARNING):
        kept = store.enforce_limits(RetentionLimits(age_s=30 * DAY_S))
    assert store.names() == ("young",)
    assert [r.getMessage() for r in caplog.records] == ["room 'old' is removed from the disk: not used for 31 days"]
    assert (kept.rooms, kept.removed) == (1, 1)
    assert kept.space_bytes == sum(path.stat().st_size for path in young.rglob("*") if path.is_file())
    assert rooms_in(store) == {young.name}


@pytest.mark.parametrize("years", [-3, 3])
def test_no_room_goes_because_the_system_clock_is_set(
    device: Device, store: RoomStore, clock: Clock, monkeypatch: pytest.MonkeyPatch, years: int
) -> None:
    """While the server runs, or before it is started again; by either, all rooms are years old or of the future."""
    limits = RetentionLimits(age_s=180 * DAY_S)
    folders = [save_room(store, device, name) for name in ("a", "b")]
    stamp(folders[0], LONG_AGO_S)
    store.enforce_limits(limits)
    real_s = time.time
    monkeypatch.setattr(time, "time", lambda: real_s() + years * 365 * DAY_S)
    clock.now_s += 60.0
    assert store.enforce_limits(limits).rooms == 2
    stamp(folders[1], real_s() - years * 365 * DAY_S)
    later = RoomStore(store._folder, clock)
    for _ in range(2):
        clock.now_s += 60.0
        assert later.enforce_limits(limits).rooms == 2


def test_idle_time_goes_on_after_a_restart(device: Device, store: RoomStore, clock: Clock) -> None:
    """The time in between, which is known by the system's clock alone, does not count."""
    save_room(store, device, "study")
    limits = RetentionLimits(age_s=30 * DAY_S)
    pass_days(store, clock, 20)
    assert store.enforce_limits(limits).rooms == 1
    clock.now_s += 20 * DAY_S
    later = RoomStore(store._folder, clock)
    assert later.enforce_limits(limits).rooms == 1
    clock.now_s += 11 * DAY_S
    assert later.enforce_limits(limits).rooms == 0


def test_idle_times_that_are_damaged_let_all_begin_anew(
    device: Device, store: RoomStore, clock: Clock, caplog: pytest.LogCaptureFixture
) -> None:
    save_room(store, device, "study")
    pass_days(store, clock, 20)
    store.enforce_limits(RetentionLimits())
    (file,) = (path for path in store._folder.iterdir() if path.is_file())
    assert file.stat().st_mode & 0o077 == 0
    *most, last = file.read_bytes()
    file.write_bytes(bytes((*most, last ^ 1)))
    later = RoomStore(store._folder, clock)
    with caplog.at_level(logging.WARNING):
        later.enforce_limits(RetentionLimits())
    assert "all rooms count as used just now" in caplog.text
    clock.now_s += 20 * DAY_S
    assert later.enforce_limits(RetentionLimits(age_s=30 * DAY_S)).rooms == 1


def test_where_they_take_too_much_the_oldest_go_first(
    device: Device, store: RoomStore, clock: Clock, caplog: pytest.LogCaptureFixture
) -> None:
    for name in ("b", "c", "a", "d"):
        save_room(store, device, name, padding_bytes=1 << 20)
        pass_days(store, clock, 1)
    with caplog.at_level(logging.WARNING):
        kept = store.enforce_limits(RetentionLimits(space_bytes=5 << 19))
    assert store.names() == ("a", "d")
    assert [r.getMessage().partition(" is")[0] for r in caplog.records] == ["room 'b'", "room 'c'"]
    assert "rooms take 4 MiB, more than 2" in caplog.text
    assert kept.space_bytes < 5 << 19
    caplog.clear()
    assert store.enforce_limits(RetentionLimits(space_bytes=5 << 19)) == kept
    assert not caplog.records


def test_no_room_that_is_in_use_goes(device: Device, store: RoomStore, clock: Clock) -> None:
    open_here = save_room(store, device, "open")
    pass_days(store, clock, 40)
    room = store.load("open", device)
    assert room is not None
    elsewhere = save_room(store, device, "elsewhere")
    everything = RetentionLimits(space_bytes=0, age_s=0.0)
    kept = store.enforce_limits(everything)
    clock.now_s += 60.0
    assert store.enforce_limits(everything) == kept
    assert (kept.rooms, kept.removed) == (2, 0)
    assert open_here.exists()
    assert elsewhere.exists()  # another process may be at work on it: it was used a minute ago
    store.release("open")
    room.close()
    pass_days(store, clock, 1)
    assert store.enforce_limits(everything).rooms == 0


def test_a_room_at_work_says_so_on_the_disk(device: Device, store: RoomStore, clock: Clock) -> None:
    """For another process on the same folder, also where nothing changes."""
    folder = save_room(store, device, "study")
    room = store.load("study", device)
    assert room is not None
    store.save(room)
    stamp(folder, LONG_AGO_S)
    other = RoomStore(store._folder, clock)
    pass_days(other, clock, 40)
    store._saves("study")._noted_s = float("-inf")  # a minute later
    assert store.save(room).written_bytes == 0
    room.close()
    assert other.enforce_limits(RetentionLimits(age_s=DAY_S)).rooms == 1


def test_damaged_saves_go_before_rooms(
    device: Device, store: RoomStore, clock: Clock, caplog: pytest.LogCaptureFixture
) -> None:
    folder = save_room(store, device, "study")
    for name in ("set-aside-1", "set-aside-2"):
        (folder / name).mkdir()
        (folder / name / "save").write_bytes(bytes(1 << 20))
        pass_days(store, clock, 20)
    with caplog.at_level(logging.WARNING):
        store.enforce_limits(RetentionLimits(age_s=30 * DAY_S))
        assert "a damaged save of room 'study', set-aside-1, is removed from the disk: not used" in caplog.text
        assert (folder / "set-aside-2").exists()
        store.enforce_limits(RetentionLimits(space_bytes=1 << 19))
    assert not (folder / "set-aside-2").exists()
    assert store.names() == ("study",)


def test_what_a_crash_left_of_a_removal_is_removed(device: Device, store: RoomStore, clock: Clock) -> None:
    (store._folder / ".forgotten-study").mkdir()
    (store._folder / ".forgotten-study" / "save").write_bytes(b"x")
    save_room(store, device, "old")
    pass_days(store, clock, 31)
    assert store.enforce_limits(RetentionLimits(age_s=30 * DAY_S)).space_bytes == 0
    assert not rooms_in(store)


def test_without_limits_nothing_goes(device: Device, store: RoomStore, clock: Clock) -> None:
    save_room(store, device, "old")
    pass_days(store, clock, 10_000)
    assert store.enforce_limits(RetentionLimits()).rooms == 1


def test_the_saver_sees_to_it(store: RoomStore) -> None:
    tidied = threading.Event()
    saver = RoomSaver(store, lambda: [], every_s=0.01, enforce_limits=tidied.set)
    saver.start()
    assert tidied.wait(20)
    saver.stop()
