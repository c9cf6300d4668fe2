"""Rooms that outlive their clients and the server: opened as they were saved, saved while they are at work."""

from __future__ import annotations

import logging
from pathlib import Path
from typing import TYPE_CHECKING

from protocol.messages import Wishes
from server.service.saving.upkeep import Kept, KeptLimits

if TYPE_CHECKING:
    from server.opencl.device import Device
    from server.room.room import Room
    from server.service.room_saver import RoomSaver
    from server.service.room_store import RoomStore
    from server.service.rooms import Rooms

log = logging.getLogger(__name__)


class KeptRooms:
    """Of one service. `open_room`, `key_digest` and `keep` are for its `Rooms`, in whatever thread."""

    def __init__(self, folder: Path, device: Device, limits: KeptLimits | None = None) -> None:
        """Nothing is read or written yet."""
        self._folder = folder
        self._device = device
        self._limits = limits or KeptLimits()
        self._store: RoomStore | None = None
        self._saver: RoomSaver | None = None
        self._rooms: Rooms | None = None
        self._is_told_of_space = False
        self.kept = Kept()
        """What the folder held when it was last looked through."""

    def start(self, rooms: Rooms) -> None:
        """Begin to save those of `rooms` that are open, every few seconds, and to keep the folder within its limits."""
        from server.service.room_saver import RoomSaver  # loads OpenCL, which a service without rooms does not need
        from server.service.room_store import RoomStore

        self._rooms, self._store = rooms, RoomStore(self._folder)
        self._saver = RoomSaver(self._store, rooms.visited, tidy=self.tidy)
        self._saver.start()

    @property
    def unsaved(self) -> int:
        """Rooms whose last save failed."""
        return len(self._saver.problems) if self._saver else 0

    def key_digest(self, name: str) -> bytes | None:
        """Of the key that a room was left with, read before all else. Raises ValueError, one line."""
        from server.service.room_store import RoomStoreError

        assert self._store is not None
        try:
            return self._store.key_digest(name)
        except RoomStoreError as error:
            raise ValueError(str(error)) from error

    def open_room(self, wishes: Wishes, name: str) -> Room:
        """The room as it was left, else a new one. Raises ValueError, one line, where what was left cannot be read."""
        from server.room.room import Room
        from server.service.room_store import RoomStoreError

        assert self._store is not None
        try:
            return self._store.load(name, self._device) or Room(self._device, wishes, name)
        except BaseException as error:
            self._store.release(name)
            if isinstance(error, RoomStoreError):
                raise ValueError(str(error)) from error
            raise

    def keep_now(self, name: str) -> None:
        """Save a room before what was done in it is acknowledged; by whoever is in it."""
        room = self._rooms.named(name) if self._rooms else None
        if room is not None and self._saver is not None:
            self._saver.save(room)

    def keep_moves(self, name: str) -> None:
        """Likewise where its objects have been moved to."""
        room = self._rooms.named(name) if self._rooms else None
        if room is not None and self._saver is not None:
            self._saver.save_moves(room)

    def keep(self, room: Room) -> None:
        """Save a room that is about to close."""
        assert self._saver is not None
        assert self._store is not None
        assert room.name is not None
        self._saver.save(room)
        self._store.release(room.name)

    def tidy(self) -> None:
        """Remove what exceeds the limits, and count what is left. Raises RoomStoreError."""
        assert self._store is not None
        self.kept = self._store.tidy(self._limits)
        most = self._limits.space_bytes
        is_too_much = most is not None and self.kept.space_bytes > most
        if is_too_much and not self._is_told_of_space:
            log.warning("rooms take more space than they may, and all of them are in use")
        self._is_told_of_space = is_too_much

    def stop(self) -> None:
        """Save what is open once more."""
        if self._saver is not None:
            self._saver.stop()
