"""Persistent rooms: loaded from disk when opened, saved in the background while in use and when closed."""

from __future__ import annotations

import logging
from pathlib import Path
from typing import TYPE_CHECKING

from protocol.messages import Wishes
from server.service.saving.retention import RetentionLimits, StorageUsage

if TYPE_CHECKING:
    from server.opencl.device import Device
    from server.room.room import Room
    from server.service.room_registry import RoomRegistry
    from server.service.saving.room_saver import RoomSaver
    from server.service.saving.room_store import RoomStore

log = logging.getLogger(__name__)


class RoomPersistence:
    """Persistence for one service, used by its `RoomRegistry`. Thread-safe."""

    def __init__(self, folder: Path, device: Device, limits: RetentionLimits | None = None) -> None:
        """Reads and writes nothing yet."""
        self._folder = folder
        self._device = device
        self._limits = limits or RetentionLimits()
        self._store: RoomStore | None = None
        self._saver: RoomSaver | None = None
        self._rooms: RoomRegistry | None = None
        self._has_warned_of_space = False
        self.storage = StorageUsage()
        """Disk usage at the last check."""

    def start(self, rooms: RoomRegistry) -> None:
        """Start to save the open `rooms` every few seconds and to keep the folder within its limits."""
        from server.service.saving.room_saver import (
            RoomSaver,  # loads OpenCL, which a service without rooms does not need
        )
        from server.service.saving.room_store import RoomStore

        self._rooms, self._store = rooms, RoomStore(self._folder)
        self._saver = RoomSaver(self._store, rooms.open_rooms, enforce_limits=self.enforce_limits)
        self._saver.start()

    @property
    def unsaved(self) -> int:
        """Number of rooms whose last save failed."""
        return len(self._saver.problems) if self._saver else 0

    def key_digest(self, name: str) -> bytes | None:
        """Digest of a saved room's key, read without loading the room. Raises ValueError."""
        from server.service.saving.room_store import RoomStoreError

        assert self._store is not None
        try:
            return self._store.key_digest(name)
        except RoomStoreError as error:
            raise ValueError(str(error)) from error

    def open_room(self, wishes: Wishes, name: str) -> Room:
        """Load the saved room, or create a new one. Raises ValueError if the save cannot be read."""
        from server.room.room import Room
        from server.service.saving.room_store import RoomStoreError

        assert self._store is not None
        try:
            return self._store.load(name, self._device) or Room(self._device, wishes, name)
        except BaseException as error:
            self._store.release(name)
            if isinstance(error, RoomStoreError):
                raise ValueError(str(error)) from error
            raise

    def save_now(self, name: str) -> str | None:
        """Save a room before a change is acknowledged. The caller must be in the room.

        Returns why it was not saved, in words for clients, or None.
        """
        assert self._saver is not None
        return self._saver.save(self._entered(name))

    def save_placements(self, name: str) -> str | None:
        """As `save_now`, but only object placements, before moves are acknowledged."""
        assert self._saver is not None
        return self._saver.save_placements(self._entered(name))

    def _entered(self, name: str) -> Room:
        room = self._rooms.get(name) if self._rooms else None
        assert room is not None
        return room

    def save_and_release(self, room: Room) -> None:
        """Save a room that is about to close."""
        assert self._saver is not None
        assert self._store is not None
        assert room.name is not None
        self._saver.save(room)
        self._store.release(room.name)

    def enforce_limits(self) -> None:
        """Delete rooms beyond the limits and update `storage`. Raises RoomStoreError."""
        assert self._store is not None
        self.storage = self._store.enforce_limits(self._limits)
        most = self._limits.space_bytes
        is_too_much = most is not None and self.storage.space_bytes > most
        if is_too_much and not self._has_warned_of_space:
            log.warning("rooms exceed their space limit, and all of them are in use")
        self._has_warned_of_space = is_too_much

    def stop(self) -> None:
        """Save all open rooms a last time."""
        if self._saver is not None:
            self._saver.stop()
