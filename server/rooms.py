"""The rooms of a service, by name: opened by their first client, shared by the others, closed behind the last."""

from __future__ import annotations

import threading
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

from protocol.messages import Wishes

if TYPE_CHECKING:
    from server.room import Room

RoomFactory = Callable[[Wishes, str], "Room"]


class Rooms:
    """For any number of threads; a room is opened and closed by one of them while the others wait."""

    def __init__(self, open_room: RoomFactory, on_closed: Callable[[Room], None] = lambda _room: None) -> None:
        """`on_closed`: called with a room that nobody is in any more, before its memory is given back."""
        self._open_room = open_room
        self._on_closed = on_closed
        self._rooms: dict[str, Room] = {}
        self._guests: Counter[str] = Counter()
        self._lock = threading.Lock()

    @contextmanager
    def entered(self, name: str, wishes: Wishes) -> Iterator[Room]:
        """The room of that name, as long as the client is in it. Raises ValueError where it cannot be opened."""
        with self._lock:
            if name not in self._rooms:
                self._rooms[name] = self._open_room(wishes, name)
            self._guests[name] += 1
            room = self._rooms[name]
        try:
            yield room
        finally:
            with self._lock:
                self._guests[name] -= 1
                if not self._guests[name]:
                    del self._guests[name]
                    self._close(self._rooms.pop(name))

    def _close(self, room: Room) -> None:
        try:
            self._on_closed(room)
        finally:
            room.close()

    def open_rooms(self) -> tuple[Room, ...]:
        """Those that somebody is in."""
        with self._lock:
            return tuple(self._rooms.values())

    @property
    def count(self) -> int:
        """Rooms that somebody is in."""
        return len(self._rooms)
