"""Rooms on disk, one folder each: saved while in use, loaded after a restart or a crash.

Saves alternate between two slots, each complete in itself. The newest undamaged slot is loaded, and object moves
written since are applied to it. Only copying the changes needs the room's lock; files are written without it.
"""

from __future__ import annotations

import hashlib
import logging
import os
import re
import shutil
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TypeVar

import pyopencl as cl

from server.opencl.device import Device
from server.room.room import Room
from server.service.saving.checksummed_files import DamagedFile, sync_folder
from server.service.saving.idle_times import IdleTimes
from server.service.saving.retention import RetentionLimits, StorageUsage, StoredItem, items_to_remove, stored_items
from server.service.saving.room_saves import SLOTS, RoomSaves, Saved, header_of
from server.service.saving.save_slot import SaveSlot

DELETED = ".forgotten-"
"""Name prefix of folders that are being deleted. No room's folder begins with it."""

T = TypeVar("T")
log = logging.getLogger(__name__)


class RoomStoreError(Exception):
    """A room could not be saved, loaded or deleted; one line. The room in memory is unchanged.

    `cause` is for clients: one line without paths of the server.
    """

    def __init__(self, message: str, cause: str) -> None:
        super().__init__(message)
        self.cause = cause


class RoomStore:
    """All rooms in one folder. Thread-safe; saves of one room are serialized."""

    def __init__(self, folder: Path, clock: Callable[[], float] = time.monotonic) -> None:
        """`clock`: seconds; never set."""
        self._folder = folder
        self._idle_times = IdleTimes(folder, clock)
        self._lock = threading.Lock()
        self._rooms: dict[str, RoomSaves] = {}
        self._removed = 0

    def save(self, room: Room) -> Saved:
        """Write the changes of a room. Raises RoomStoreError; existing saves are then unchanged."""
        if room.name is None:
            raise ValueError("a room without a name is of one session alone: it is not saved")
        saves = self._saves(room.name)
        with saves.lock:
            return _or_store_error(f"room {room.name!r} was not saved, it goes on in memory", lambda: saves.save(room))

    def save_placements(self, room: Room) -> None:
        """Write only object placements, or a full save if more has changed. Raises RoomStoreError."""
        if room.name is None:
            raise ValueError("a room without a name is of one session alone: it is not saved")
        saves = self._saves(room.name)
        what = f"what was moved in room {room.name!r} was not saved, it goes on in memory"
        if not _or_store_error(what, lambda: saves.save_placements(room)):
            self.save(room)

    def key_digest(self, name: str) -> bytes | None:
        """Digest of a saved room's key; None if there is no undamaged save with one.

        Reads only headers. For rooms that are not open. Raises RoomStoreError.
        """
        saves = RoomSaves(name, self._folder / folder_name(name))
        return _or_store_error(f"room {name!r} was not loaded", saves.key_digest)

    def load(self, name: str, device: Device) -> Room | None:
        """The room from its newest undamaged save; None if there is none.

        Damaged saves are set aside under another name and logged. Raises RoomStoreError.
        """
        saves = self._saves(name)
        with saves.lock:
            return _or_store_error(f"room {name!r} was not loaded", lambda: saves.load(device))

    def names(self) -> tuple[str, ...]:
        """Sorted names of all saved rooms. Raises RoomStoreError."""
        return _or_store_error("rooms were not listed", lambda: tuple(sorted(set(self._names()))))

    def delete(self, name: str) -> None:
        """Delete all saves of a room, including damaged ones. Raises RoomStoreError."""
        saves = self._saves(name)
        with saves.lock, self._lock:
            _or_store_error(f"room {name!r} was not deleted", lambda: self._delete(saves.folder))
            self._rooms.pop(name, None)

    def release(self, name: str) -> None:
        """Free the memory held for a closed room. Its saves stay."""
        saves = self._saves(name)
        with saves.lock, self._lock:
            saves.note_used()
            self._rooms.pop(name, None)

    def enforce_limits(self, limits: RetentionLimits) -> StorageUsage:
        """Delete saves beyond `limits`, with one log line each. Returns the remaining disk usage.

        Idle times grow by the time since the last call. Of rooms in use, only damaged saves are deleted. To be called
        by one thread. Raises RoomStoreError.
        """
        return _or_store_error("rooms were not tidied up", lambda: self._enforce_limits(limits))

    def _enforce_limits(self, limits: RetentionLimits) -> StorageUsage:
        with self._lock:
            in_use = {saves.folder for saves in self._rooms.values()}
        left = list(self._idle_times.updated(stored_items(self._folder, DELETED)))
        for piece, why in list(items_to_remove(left, limits, in_use)):
            name = self._name_of(piece)
            with self._lock:
                if piece.is_room and any(saves.folder == piece.folder for saves in self._rooms.values()):
                    continue  # a client has entered meanwhile
                self._delete(piece.folder)
            left.remove(piece)
            self._removed += 1
            log.warning("%s is removed from the disk: %s", name, why)
        self._idle_times.write()
        rooms = sum(piece.is_room for piece in left)
        return StorageUsage(rooms, sum(piece.space_bytes for piece in left), self._removed)

    def _name_of(self, piece: StoredItem) -> str:
        """Readable name for the log."""
        room = piece.folder if piece.is_room else piece.folder.parent
        name = next((repr(h.name) for slot in SLOTS if (h := header_of(SaveSlot(room / slot)))), room.name)
        return f"room {name}" if piece.is_room else f"a damaged save of room {name}, {piece.folder.name},"

    def _saves(self, name: str) -> RoomSaves:
        with self._lock:
            return self._rooms.setdefault(name, RoomSaves(name, self._folder / folder_name(name)))

    def _names(self) -> Iterator[str]:
        if not self._folder.exists():
            return
        for folder in self._folder.iterdir():
            for slot in SLOTS:
                header = header_of(SaveSlot(folder / slot))
                if header is not None and folder_name(header.name) == folder.name:
                    yield header.name

    def _delete(self, folder: Path) -> None:
        self._clear()
        if folder.exists():
            os.replace(folder, self._folder / f"{DELETED}{folder.name}")
            sync_folder(self._folder)
        self._clear()

    def _clear(self) -> None:
        for gone in self._folder.glob(f"{DELETED}*"):
            shutil.rmtree(gone)


def folder_name(name: str) -> str:
    """Folder name of a room: its letters and digits for readability, and a digest for uniqueness."""
    plain = re.sub("[^a-z0-9]+", "-", name.lower()).strip("-")[:40]
    return f"{plain or 'room'}-{hashlib.blake2b(name.encode('utf-8', 'surrogatepass'), digest_size=12).hexdigest()}"


def _or_store_error(what: str, work: Callable[[], T]) -> T:
    try:
        return work()
    except OSError as error:
        where = f" ({error.filename})" if error.filename else ""
        cause = error.strerror or type(error).__name__
        raise RoomStoreError(
            f"{what}: {error.strerror or error}{where}: is the disk full or not writable?", cause
        ) from error
    except DamagedFile as error:
        raise RoomStoreError(f"{what}: {error}", "an earlier file of the room is damaged") from error
    except cl.MemoryError as error:
        cause = "the device has no memory left"
        raise RoomStoreError(f"{what}: {cause}", cause) from error
