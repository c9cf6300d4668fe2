"""Rooms that outlive their clients and the server: opened as they were saved, saved while they are at work."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from protocol.messages import Wishes

if TYPE_CHECKING:
    from server.opencl.device import Device
    from server.room import Room
    from server.room_saver import RoomSaver
    from server.room_store import RoomStore
    from server.rooms import Rooms


class KeptRooms:
    """Of one service. `open_room` and `keep` are for its `Rooms`, in whatever thread."""

    def __init__(self, folder: Path, device: Device) -> None:
        """Nothing is read or written yet."""
        self._folder = folder
        self._device = device
        self._store: RoomStore | None = None
        self._saver: RoomSaver | None = None

    def start(self, rooms: Rooms) -> None:
        """Begin to save those of `rooms` that are open, every few seconds."""
        from server.room_saver import RoomSaver  # loads OpenCL, which a service without rooms does not need
        from server.room_store import RoomStore

        self._store = RoomStore(self._folder)
        self._saver = RoomSaver(self._store, rooms.visited)
        self._saver.start()

    def open_room(self, wishes: Wishes, name: str) -> Room:
        """The room as it was left, else a new one. Raises ValueError, one line, where what was left cannot be read."""
        from server.room import Room
        from server.room_store import RoomStoreError

        assert self._store is not None
        try:
            return self._store.load(name, self._device) or Room(self._device, wishes, name)
        except RoomStoreError as error:
            raise ValueError(str(error)) from error

    def keep_now(self, room: Room) -> None:
        """Save a room that somebody is in, as when what was done in it is about to be acknowledged."""
        assert self._saver is not None
        self._saver.save(room)

    def keep(self, room: Room) -> None:
        """Save a room that is about to close."""
        assert self._saver is not None
        assert self._store is not None
        assert room.name is not None
        self._saver.save(room)
        self._store.release(room.name)

    def stop(self) -> None:
        """Save what is open once more."""
        if self._saver is not None:
            self._saver.stop()
