"""The rooms of a service: opened once, closed behind the last, each at its own pace, with keys."""

from __future__ import annotations

import contextlib
import threading
from types import SimpleNamespace

import pytest

from protocol.messages import Wishes
from server.service.room_registry import RoomRegistry, WrongRoomKey, key_digest_of

PATIENCE_S = 60.0


class House:
    """Rooms that are counted instead of built."""

    def __init__(self) -> None:
        self.opened: list[str] = []
        self.closed: list[str] = []
        self.kept: list[str] = []
        self.slow = threading.Event()
        self.slow.set()
        self.digests: dict[str, bytes] = {}
        """Of rooms that were left."""
        self.rooms = RoomRegistry(self.open, lambda room: self.kept.append(room.name), self.digests.get)

    def open(self, _wishes: Wishes, name: str) -> SimpleNamespace:
        assert name != "slow" or self.slow.wait(PATIENCE_S)
        if name == "broken":
            raise ValueError("it cannot be read")
        self.opened.append(name)
        return SimpleNamespace(name=name, key_digest=None, close=lambda: self.closed.append(name))


@pytest.fixture
def house() -> House:
    return House()


def test_a_room_is_opened_once_and_closed_behind_the_last(house: House) -> None:
    with house.rooms.entered("a", Wishes()) as first:
        with house.rooms.entered("a", Wishes()) as second:
            assert first is second
        assert house.rooms.count == 1
        assert not house.closed
    assert (house.opened, house.kept, house.closed) == (["a"], ["a"], ["a"])
    assert house.rooms.count == 0


def test_one_that_cannot_be_opened_may_be_tried_again(house: House) -> None:
    for _ in range(2):
        with pytest.raises(ValueError, match="cannot be read"), house.rooms.entered("broken", Wishes()):
            pass
    assert house.rooms.count == 0
    assert not house.kept


def test_a_room_that_opens_slowly_holds_up_nobody_else(house: House) -> None:
    house.slow.clear()
    inside = threading.Event()

    def enter_slow() -> None:
        with house.rooms.entered("slow", Wishes()):
            inside.set()

    slow = threading.Thread(target=enter_slow)
    slow.start()
    with house.rooms.entered("other", Wishes()):
        assert house.opened == ["other"]
        assert [room.name for room in house.rooms.open_rooms()] == ["other"]
    house.slow.set()
    assert inside.wait(PATIENCE_S)
    slow.join(PATIENCE_S)


def test_a_room_that_is_visited_stays_open_until_then(house: House) -> None:
    with house.rooms.entered("a", Wishes()):
        visits = house.rooms.open_rooms()
        assert next(visits).name == "a"
    assert not house.closed
    assert list(visits) == []
    assert house.closed == ["a"]


def test_many_that_come_and_go_never_meet_two_rooms_of_one_name(house: House) -> None:
    faults: list[str] = []

    def come_and_go() -> None:
        for _ in range(200):
            with house.rooms.entered("a", Wishes()):
                if len(house.opened) - len(house.closed) != 1:
                    faults.append("two at once")

    threads = [threading.Thread(target=come_and_go) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(PATIENCE_S)
        assert not thread.is_alive()
    assert not faults
    assert len(house.opened) == len(house.closed)


def test_whoever_opens_a_room_sets_its_key(house: House) -> None:
    with house.rooms.entered("a", Wishes(), "k3y"):
        for key in (None, "", "K3y"):
            with pytest.raises(WrongRoomKey, match="has a key of its own"), house.rooms.entered("a", Wishes(), key):
                pass
        with house.rooms.entered("a", Wishes(), "k3y"):
            pass
    assert key_digest_of(None) == b""
    assert b"k3y" not in key_digest_of("k3y")


def test_a_room_that_was_left_is_not_opened_for_a_wrong_key(house: House) -> None:
    house.digests["a"] = key_digest_of("k3y")
    for key in (None, "guess"):
        with pytest.raises(WrongRoomKey, match="has a key of its own"), house.rooms.entered("a", Wishes(), key):
            pass
    assert (house.opened, house.rooms.count) == ([], 0)
    with house.rooms.entered("a", Wishes(), "k3y"):
        assert house.opened == ["a"]


def test_nothing_is_kept_of_rooms_that_were_left(house: House) -> None:
    for name in ("a", "b", "broken"):
        with contextlib.suppress(ValueError), house.rooms.entered(name, Wishes()):
            pass
    assert not house.rooms._opening_locks
    assert not house.rooms._clients
