"""The open rooms of a service by name: opened for the first client, shared, and closed after the last one leaves."""

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


class WrongRoomKey(ValueError):
    """The room has another key."""


def key_digest_of(key: str | None) -> bytes:
    """SHA-256 of a room's key, which is what is stored; empty for a room without a key."""
    return b"" if key is None else sha256(key.encode()).digest()


def _check_key(name: str, digest: bytes | None, key_digest: bytes) -> None:
    """`digest`: None for a room that has no key yet. Raises WrongRoomKey."""
    if digest is not None and not compare_digest(digest, key_digest):
        raise WrongRoomKey(f"room {name!r} has a key of its own, and this is not it: ask who opened it")


class RoomRegistry:
    """Thread-safe. While one thread opens or closes a room, others that need the same room wait."""

    def __init__(
        self,
        open_room: RoomFactory,
        on_closed: Callable[[Room], None] = lambda _room: None,
        stored_digest: Callable[[str], bytes | None] = lambda _name: None,
    ) -> None:
        """`on_closed`: called with a room after its last client has left, before its memory is freed.

        `stored_digest`: returns the key digest of a room that is not open, or None if it has no key yet. `open_room`
        and `stored_digest` may raise ValueError.
        """
        self._stored_digest = stored_digest
        self._open_room = open_room
        self._on_closed = on_closed
        self._rooms: dict[str, Room] = {}
        self._clients: Counter[str] = Counter()
        self._opening_locks: dict[str, threading.Lock] = {}
        """One lock per name, held while that room is opened or closed. Other rooms are not blocked."""
        self._lock = threading.Lock()

    @contextmanager
    def entered(self, name: str, wishes: Wishes, key: str | None = None) -> Iterator[Room]:
        """Context in which the client is in the named room.

        The first client sets the room's `key`; later ones must give the same key. Raises WrongRoomKey, or ValueError
        if the room cannot be opened.
        """
        key_digest = key_digest_of(key)
        with self._lock:
            self._clients[name] += 1
        try:
            with self._opening_lock(name):
                room = self._rooms.get(name) or self._open(name, wishes, key_digest)
            _check_key(name, room.key_digest, key_digest)
            yield room
        finally:
            self._leave(name)

    def _open(self, name: str, wishes: Wishes, key_digest: bytes) -> Room:
        """Open a room; the caller holds its opening lock. The key is checked before any costly work."""
        _check_key(name, self._stored_digest(name), key_digest)
        room = self._open_room(wishes, name)
        room.key_digest = key_digest if room.key_digest is None else room.key_digest
        self._rooms[name] = room
        return room

    def get(self, name: str) -> Room | None:
        """The room if it is open. The caller must be in it."""
        return self._rooms.get(name)

    def open_rooms(self) -> Iterator[Room]:
        """Iterate over the open rooms. Each stays open during its iteration."""
        for name in tuple(self._rooms):
            with self._lock:
                room = self._rooms.get(name)
                if room is None:
                    continue
                self._clients[name] += 1
            try:
                yield room
            finally:
                self._leave(name)

    def _leave(self, name: str) -> None:
        with self._lock:
            self._clients[name] -= 1
            if self._clients[name]:
                return
        opening_lock = self._opening_lock(name)
        with opening_lock:
            with self._lock:
                if self._clients[name] or self._opening_locks.get(name) is not opening_lock:
                    return  # another client has entered meanwhile, or the room is closed already
                del self._clients[name]
                room = self._rooms.pop(name, None)
            if room is not None:
                self._close(room)
            with self._lock:
                if not self._clients[name]:
                    del self._opening_locks[name]  # the next client creates a new one

    def _opening_lock(self, name: str) -> threading.Lock:
        with self._lock:
            return self._opening_locks.setdefault(name, threading.Lock())

    def _close(self, room: Room) -> None:
        try:
            self._on_closed(room)
        finally:
            room.close()

    @property
    def count(self) -> int:
        """Number of open rooms."""
        return len(self._rooms)
