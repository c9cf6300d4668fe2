"""Rooms kept on disk, each in a folder of its own: saved while they are at work, loaded after a crash or a restart.

A room's saves go in turn to two slots, each whole in itself; of the two the newer one that is undamaged counts, with
its objects where they have been moved to since. Writing a save goes on outside of the room's lock: under it only what
has changed is copied.
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
from server.service.saving.files import DamagedFile, sync_folder
from server.service.saving.room_saves import SLOTS, RoomSaves, Saved, header_of
from server.service.saving.slot import Slot
from server.service.saving.upkeep import Kept, KeptLimits, Piece, pieces_in, surplus

FORGOTTEN = ".forgotten-"
"""Begins the name of a folder that is about to be deleted, and of no room's."""

T = TypeVar("T")
log = logging.getLogger(__name__)


class RoomStoreError(Exception):
    """One line: which room could not be saved, loaded or forgotten, and why. The room in memory is as it was."""


class RoomStore:
    """Rooms in one folder. Methods are for any thread; saves of one room come one after the other."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._lock = threading.Lock()
        self._rooms: dict[str, RoomSaves] = {}
        self._removed = 0

    def save(self, room: Room) -> Saved:
        """Write what has changed of a room. Raises RoomStoreError; the saves that there are then stay."""
        if room.name is None:
            raise ValueError("a room without a name is of one session alone: it is not saved")
        saves = self._saves(room.name)
        with saves.lock:
            return _or_told(f"room {room.name!r} was not saved, it goes on in memory", lambda: saves.save(room))

    def save_moves(self, room: Room) -> None:
        """Write where objects have been moved to; all where more has changed. Raises RoomStoreError, as `save` does."""
        if room.name is None:
            raise ValueError("a room without a name is of one session alone: it is not saved")
        saves = self._saves(room.name)
        what = f"what was moved in room {room.name!r} was not saved, it goes on in memory"
        if not _or_told(what, lambda: saves.save_moves(room)):
            self.save(room)

    def key_digest(self, name: str) -> bytes | None:
        """Of the room's key as it was saved; None where there is no save, or none that is whole and says it.

        Reads little, and keeps nothing of the room in memory. For rooms that are not open. Raises RoomStoreError.
        """
        saves = RoomSaves(name, self._folder / folder_name(name))
        return _or_told(f"room {name!r} was not loaded", saves.key_digest)

    def load(self, name: str, device: Device) -> Room | None:
        """The room as it was saved last, or before where that save is damaged; None where there is none.

        Damaged saves are set aside, each told in one line of the log. Raises RoomStoreError.
        """
        saves = self._saves(name)
        with saves.lock:
            return _or_told(f"room {name!r} was not loaded", lambda: saves.load(device))

    def names(self) -> tuple[str, ...]:
        """Of all rooms that have a save, in order. Raises RoomStoreError."""
        return _or_told("rooms were not listed", lambda: tuple(sorted(set(self._names()))))

    def forget(self, name: str) -> None:
        """Delete a room's saves, those set aside too. Raises RoomStoreError."""
        saves = self._saves(name)
        with saves.lock, self._lock:
            _or_told(f"room {name!r} was not deleted", lambda: self._delete(saves.folder))
            self._rooms.pop(name, None)

    def release(self, name: str) -> None:
        """Keep nothing in memory of a room that has been closed. Its saves stay."""
        saves = self._saves(name)
        with saves.lock, self._lock:
            saves.note_used()
            self._rooms.pop(name, None)

    def tidy(self, limits: KeptLimits, now_s: float | None = None) -> Kept:
        """Delete what exceeds `limits`, each told in one line of the log; what is left.

        `now_s`: since 1970. Of rooms that have not been released nothing goes but damaged saves. Raises RoomStoreError.
        """
        return _or_told(
            "rooms were not tidied up", lambda: self._tidied(limits, time.time() if now_s is None else now_s)
        )

    def _tidied(self, limits: KeptLimits, now_s: float) -> Kept:
        with self._lock:
            in_use = {saves.folder for saves in self._rooms.values()}
        left = list(pieces_in(self._folder, FORGOTTEN))
        for piece, why in list(surplus(left, limits, now_s, in_use)):
            name = self._name_of(piece)
            with self._lock:
                if piece.is_room and any(saves.folder == piece.folder for saves in self._rooms.values()):
                    continue  # somebody has come
                self._delete(piece.folder)
            left.remove(piece)
            self._removed += 1
            log.warning("%s is removed from the disk: %s", name, why)
        rooms = sum(piece.is_room for piece in left)
        return Kept(rooms, sum(piece.space_bytes for piece in left), self._removed)

    def _name_of(self, piece: Piece) -> str:
        """For people."""
        room = piece.folder if piece.is_room else piece.folder.parent
        name = next((repr(h.name) for slot in SLOTS if (h := header_of(Slot(room / slot)))), room.name)
        return f"room {name}" if piece.is_room else f"a damaged save of room {name}, {piece.folder.name},"

    def _saves(self, name: str) -> RoomSaves:
        with self._lock:
            return self._rooms.setdefault(name, RoomSaves(name, self._folder / folder_name(name)))

    def _names(self) -> Iterator[str]:
        if not self._folder.exists():
            return
        for folder in self._folder.iterdir():
            for slot in SLOTS:
                header = header_of(Slot(folder / slot))
                if header is not None and folder_name(header.name) == folder.name:
                    yield header.name

    def _delete(self, folder: Path) -> None:
        self._clear()
        if folder.exists():
            os.replace(folder, self._folder / f"{FORGOTTEN}{folder.name}")
            sync_folder(self._folder)
        self._clear()

    def _clear(self) -> None:
        for gone in self._folder.glob(f"{FORGOTTEN}*"):
            shutil.rmtree(gone)


def folder_name(name: str) -> str:
    """Of a room's folder: its plain letters, for people, and a digest that tells it from all others."""
    plain = re.sub("[^a-z0-9]+", "-", name.lower()).strip("-")[:40]
    return f"{plain or 'room'}-{hashlib.blake2b(name.encode('utf-8', 'surrogatepass'), digest_size=12).hexdigest()}"


def _or_told(what: str, work: Callable[[], T]) -> T:
    try:
        return work()
    except OSError as error:
        where = f" ({error.filename})" if error.filename else ""
        raise RoomStoreError(f"{what}: {error.strerror or error}{where}: is the disk full or not writable?") from error
    except DamagedFile as error:
        raise RoomStoreError(f"{what}: {error}") from error
    except cl.MemoryError as error:
        raise RoomStoreError(f"{what}: the device has no memory left") from error
