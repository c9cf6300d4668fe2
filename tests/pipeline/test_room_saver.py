"""Rooms are saved in the background, and what goes wrong there is told once."""

from __future__ import annotations

import logging
import threading
from collections.abc import Iterator
from pathlib import Path

import pytest

from server.opencl.device import Device
from server.room.room import Room
from server.service.saving.room_saver import RoomSaver
from server.service.saving.room_saves import Saved
from server.service.saving.room_store import RoomStore
from tests.scenes.faulty_disk import FaultyDisk, full
from tests.scenes.kept_rooms import client_of, print_of, scan
from tests.scenes.rooms import wishes


@pytest.fixture
def room(device: Device) -> Iterator[Room]:
    room = Room(device, wishes("given"), "study")
    scan(client_of(device, room, wishes("given")), range(1))
    yield room
    room.close()


def test_open_rooms_are_saved_without_being_asked_to(device: Device, room: Room, tmp_path: Path) -> None:
    seen, twice = list[Saved](), threading.Event()

    def note(_room: Room, saved: Saved) -> None:
        seen.append(saved)
        if len(seen) == 2:
            twice.set()

    alone = Room(device, wishes("given"))
    saver = RoomSaver(RoomStore(tmp_path), lambda: [alone, room], every_s=0.01, on_saved=note)
    saver.start()
    assert twice.wait(60)
    saver.stop()
    assert seen[0].written_bytes > 0
    assert seen[1].written_bytes == 0  # nothing had changed
    assert RoomStore(tmp_path).names() == ("study",)
    alone.close()


def test_what_came_last_is_saved_at_the_end(device: Device, room: Room, tmp_path: Path) -> None:
    saver = RoomSaver(RoomStore(tmp_path), lambda: [room], every_s=3600)
    saver.start()
    saver.stop()
    again = RoomStore(tmp_path).load("study", device)
    assert again is not None
    assert print_of(again) == print_of(room)
    again.close()


def test_a_room_that_cannot_be_saved_is_told_once_and_tried_again(
    room: Room, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    disk = FaultyDisk(monkeypatch)
    saver = RoomSaver(RoomStore(tmp_path), lambda: [room])
    with caplog.at_level(logging.INFO):
        for _ in range(3):
            disk.fail_at(4, full())
            assert saver.save(room) == "No space left on device"
        assert len(caplog.records) == 1
        assert "No space left on device" in saver.problems["study"]
        disk.fails_at = 0
        assert saver.save(room) is None
    assert not saver.problems
    assert caplog.records[-1].getMessage() == "room 'study' is saved again"
