"""Rooms kept on disk, each in a folder of its own: saved while they are at work, loaded after a crash or a restart.

A room's saves go in turn to two slots, each whole in itself; of the two the newer one that is undamaged counts. Writing
a save goes on outside of the room's lock: under it only what has changed is copied.
"""

from __future__ import annotations

import hashlib
import logging
import os
import re
import shutil
import threading
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TypeVar

import pyopencl as cl

from server.opencl.device import Device
from server.room import Room
from server.saving.files import DamagedFile, sync_folder
from server.saving.slot import Slot
from server.saving.snapshot import Snapshot, rebuilt, snapshot
from server.saving.state import VERSION, Header, state_to_bytes

SLOTS = ("0", "1")
FORGOTTEN = ".forgotten-"
"""Begins the name of a folder that is about to be deleted, and of no room's."""

T = TypeVar("T")
log = logging.getLogger(__name__)


class RoomStoreError(Exception):
    """One line: which room could not be saved, loaded or forgotten, and why. The room in memory is as it was."""


@dataclass(frozen=True)
class Saved:
    """What a save took."""

    written_bytes: int
    """0 where nothing had changed."""
    bricks: int
    lock_ms: float
    """For how long no frame could be worked on."""


class RoomStore:
    """Rooms in one folder. Methods are for any thread; saves of one room come one after the other."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._lock = threading.Lock()
        self._rooms: dict[str, _Saves] = {}

    def save(self, room: Room) -> Saved:
        """Write what has changed of a room. Raises RoomStoreError; the saves that there are then stay."""
        if room.name is None:
            raise ValueError("a room without a name is of one session alone: it is not saved")
        saves = self._saves(room.name)
        with saves.lock:
            return _or_told(f"room {room.name!r} was not saved, it goes on in memory", lambda: saves.save(room))

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
            self._rooms.pop(name, None)

    def _saves(self, name: str) -> _Saves:
        with self._lock:
            return self._rooms.setdefault(name, _Saves(name, self._folder / folder_name(name)))

    def _names(self) -> Iterator[str]:
        if not self._folder.exists():
            return
        for folder in self._folder.iterdir():
            for slot in SLOTS:
                header = _header(Slot(folder / slot))
                if header is not None and folder_name(header.name) == folder.name:
                    yield header.name

    def _delete(self, folder: Path) -> None:
        if folder.exists():
            os.replace(folder, self._folder / f"{FORGOTTEN}{folder.name}")
            sync_folder(self._folder)
        for gone in self._folder.glob(f"{FORGOTTEN}*"):
            shutil.rmtree(gone)


class _Saves:
    """Of one room."""

    def __init__(self, name: str, folder: Path) -> None:
        self.name = name
        self.folder = folder
        self.lock = threading.Lock()
        self._slots = [Slot(folder / slot) for slot in SLOTS]
        self._sequences: list[int] | None = None
        self._next = 0
        self._written: Snapshot | None = None
        """Last, without what is large."""

    def save(self, room: Room) -> Saved:
        sequences = self._known_sequences()
        if self._has_all(room):
            return Saved(0, 0, 0.0)
        number = sequences.index(min(sequences))
        taken = snapshot(room, self._slots[number])
        self._next += 1
        size = self._slots[number].write(Header(VERSION, self.name, self._next), taken)
        sequences[number], self._written = self._next, replace(taken, bricks=[], volume=None)
        return Saved(size, sum(len(places) for places, _, _ in taken.bricks), taken.lock_ms)

    def _has_all(self, room: Room) -> bool:
        """Whether the newest save is of the room as it is."""
        sequences, volume = self._known_sequences(), room.reconstruction.volume
        newest = self._slots[sequences.index(max(sequences))]
        if self._written is None or (volume and newest.change_of(volume) != volume.changes):
            return False
        return _is_same(snapshot(room, newest), self._written)

    def load(self, device: Device) -> Room | None:
        sequences = self._known_sequences()
        self._written = None
        unreadable = [number for number, slot in enumerate(self._slots) if sequences[number] == 0]
        newest_first = sorted(range(len(SLOTS)), key=lambda number: -sequences[number])
        for number in dict.fromkeys([*unreadable, *newest_first]):
            slot = self._slots[number]
            try:
                if slot.header() is not None:
                    return rebuilt(self.name, slot.read(), slot, device)
            except DamagedFile as error:
                sequences[number] = 0
                log.warning("a save of room %r is set aside as %s: %s", self.name, slot.set_aside(), error)
        return None

    def _known_sequences(self) -> list[int]:
        """Of each slot's save, 0 where there is none."""
        if self._sequences is None:
            headers = [_header(slot) for slot in self._slots]
            self._sequences = [header.sequence if header else 0 for header in headers]
            self._next = max(self._sequences)
        return self._sequences


def folder_name(name: str) -> str:
    """Of a room's folder: its plain letters, for people, and a digest that tells it from all others."""
    plain = re.sub("[^a-z0-9]+", "-", name.lower()).strip("-")[:40]
    return f"{plain or 'room'}-{hashlib.blake2b(name.encode('utf-8', 'surrogatepass'), digest_size=12).hexdigest()}"


def _header(slot: Slot) -> Header | None:
    """None also where it is damaged."""
    try:
        return slot.header()
    except DamagedFile:
        return None


def _is_same(a: Snapshot, b: Snapshot) -> bool:
    """Whether nothing but voxels has changed between two snapshots of one room."""
    of_a, of_b = ([(kept.object_id, id(kept.mesh), id(kept.place)) for kept in taken.objects] for taken in (a, b))
    return of_a == of_b and state_to_bytes(a.state) == state_to_bytes(b.state)


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
