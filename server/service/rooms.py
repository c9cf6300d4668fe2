"""The rooms of a service, by name: opened by their first client, shared by the others, closed behind the last."""

from __future__ import annotations

import threading
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from hashlib import sha256
from hmac import compare_digest
from typing import TYPE_CHECKING

from protocol.messages import Wishes

if TYPE_CHECKING:
    from server.room.room import Room

RoomFactory = Callable[[Wishes, str], "Room"]


class RoomLocked(ValueError):
    """One line: the room has another key."""


def lock_of(key: str | None) -> bytes:
    """What is kept of a room's key, and may be seen by whoever reads the disk; empty for a room without."""
    return b"" if key is None else sha256(key.encode()).digest()


def _compare(name: str, digest: bytes | None, lock: bytes) -> None:
    """`digest`: None for a room that has no key yet. Raises RoomLocked."""
    if digest is not None and not compare_digest(digest, lock):
        raise RoomLocked(f"room {name!r} has a key of its own, and this is not it: ask who opened it")


class Rooms:
    """For any number of threads; a room is opened and closed by one of them while the others wait."""

    def __init__(
        self,
        open_room: RoomFactory,
        on_closed: Callable[[Room], None] = lambda _room: None,
        kept_digest: Callable[[str], bytes | None] = lambda _name: None,
    ) -> None:
        """`on_closed`: called with a room that nobody is in any more, before its memory is given back.

        `kept_digest`: of the key of a room that is not open; None where it has none yet. Like `open_room` it may raise
        ValueError.
        """
        self._kept_digest = kept_digest
        self._open_room = open_room
        self._on_closed = on_closed
        self._rooms: dict[str, Room] = {}
        self._guests: Counter[str] = Counter()
        self._doors: dict[str, threading.Lock] = {}
        """One a name: held while that room is opened or closed, which takes disk and device; other rooms go on."""
        self._lock = threading.Lock()

    @contextmanager
    def entered(self, name: str, wishes: Wishes, key: str | None = None) -> Iterator[Room]:
        """The room of that name, as long as the client is in it.

        Whoever opens a room sets its `key`, and the others have to know it. Raises RoomLocked, or ValueError where the
        room cannot be opened.
        """
        lock = lock_of(key)
        with self._lock:
            self._guests[name] += 1
        try:
            with self._door(name):
                room = self._rooms.get(name) or self._opened(name, wishes, lock)
            _compare(name, room.key_digest, lock)
            yield room
        finally:
            self._leave(name)

    def _opened(self, name: str, wishes: Wishes, lock: bytes) -> Room:
        """By whoever is at its door; not before the key fits: opening takes disk and device."""
        _compare(name, self._kept_digest(name), lock)
        room = self._open_room(wishes, name)
        room.key_digest = lock if room.key_digest is None else room.key_digest
        self._rooms[name] = room
        return room

    def named(self, name: str) -> Room | None:
        """For somebody who is in it."""
        return self._rooms.get(name)

    def visited(self) -> Iterator[Room]:
        """Each room that somebody is in, kept open while it is looked at."""
        for name in tuple(self._rooms):
            with self._lock:
                room = self._rooms.get(name)
                if room is None:
                    continue
                self._guests[name] += 1
            try:
                yield room
            finally:
                self._leave(name)

    def _leave(self, name: str) -> None:
        with self._lock:
            self._guests[name] -= 1
            if self._guests[name]:
                return
        door = self._door(name)
        with door:
            with self._lock:
                if self._guests[name] or self._doors.get(name) is not door:
                    return  # somebody has come meanwhile, or has closed it
                del self._guests[name]
                room = self._rooms.pop(name, None)
            if room is not None:
                self._close(room)
            with self._lock:
                if not self._guests[name]:
                    del self._doors[name]  # whoever comes makes a new one

    def _door(self, name: str) -> threading.Lock:
        with self._lock:
            return self._doors.setdefault(name, threading.Lock())

    def _close(self, room: Room) -> None:
        try:
            self._on_closed(room)
        finally:
            room.close()

    @property
    def count(self) -> int:
        """Rooms that somebody is in."""
        return len(self._rooms)
