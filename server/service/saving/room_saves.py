"""The saves of one room: two slots in turn, and where objects have been moved to since."""

from __future__ import annotations

import contextlib
import logging
import os
import threading
import time
from dataclasses import dataclass, replace
from pathlib import Path

from server.opencl.device import Device
from server.room.room import Room
from server.service.saving.files import DamagedFile
from server.service.saving.moves import Moves, forget_moves, moves_since, read_moves, write_moves
from server.service.saving.room_snapshots import rebuilt, snapshot
from server.service.saving.slot import Slot
from server.service.saving.snapshot import Snapshot
from server.service.saving.state import VERSION, Header, state_to_bytes

SLOTS = ("0", "1")
NOTE_USE_S = 60.0
"""Between two times that the disk is told that a room is in use."""

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Saved:
    """What a save took."""

    written_bytes: int
    """0 where nothing had changed."""
    bricks: int
    lock_ms: float
    """For how long no frame could be worked on."""


class RoomSaves:
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
        self._moves_lock = threading.Lock()
        self._moves_kept = -1
        """Revision of the objects whose places are on the disk."""
        self._noted_s = float("-inf")

    def note_used(self) -> None:
        """So that it is not taken for a room that nobody needs."""
        self._noted_s = time.monotonic()
        with contextlib.suppress(OSError):  # there may be nothing on the disk
            os.utime(self.folder)

    def save(self, room: Room) -> Saved:
        if time.monotonic() - self._noted_s > NOTE_USE_S:
            self.note_used()
        sequences = self._known_sequences()
        if self._has_all(room):
            return Saved(0, 0, 0.0)
        number = sequences.index(min(sequences))
        taken = snapshot(room, self._slots[number])
        self._next += 1
        size = self._slots[number].write(self._header(taken), taken)
        sequences[number], self._written = self._next, replace(taken, bricks=[], volume=None)
        return Saved(size, sum(len(places) for places, _, _ in taken.bricks), taken.lock_ms)

    def _header(self, taken: Snapshot) -> Header:
        objects = taken.inventory
        return Header(VERSION, self.name, self._next, taken.state.key_digest, objects.revision, objects.owed)

    def save_moves(self, room: Room) -> bool:
        """Whether that was enough: nothing but places of objects has changed since the last save.

        Waits neither for a frame nor for a save.
        """
        with self._moves_lock:
            written, now = self._written, room.objects.inventory()
            moves = moves_since(written.inventory, now) if written else None
            if moves is None:
                return False
            if moves.moved and self._moves_kept != now.revision:
                write_moves(self.folder, moves)
                self._moves_kept = now.revision
            return True

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
                header = slot.header()
                if header is not None:
                    state, moves = slot.read(), self._moves_after(header)
                    return _with_moves(rebuilt(self.name, state, slot, device), header, moves)
            except DamagedFile as error:
                sequences[number] = 0
                log.warning("a save of room %r is set aside as %s: %s", self.name, slot.set_aside(), error)
        forget_moves(self.folder)
        return None

    def _moves_after(self, header: Header) -> Moves | None:
        """Of the objects of that save. Raises OSError."""
        try:
            moves = read_moves(self.folder)
        except DamagedFile as error:
            log.warning("objects of room %r are where they were some seconds before: %s", self.name, error)
            return None
        if moves is None or moves.follow(header.revision):
            return moves
        forget_moves(self.folder)  # they are of a save that is not there any more
        return None

    def key_digest(self) -> bytes | None:
        sequences = self._known_sequences()
        for number in sorted(range(len(SLOTS)), key=lambda number: -sequences[number]):
            try:
                if sequences[number]:
                    return self._slots[number].key_digest()
            except DamagedFile:
                continue  # told when it is loaded
        return None

    def _known_sequences(self) -> list[int]:
        """Of each slot's save, 0 where there is none."""
        if self._sequences is None:
            headers = [header_of(slot) for slot in self._slots]
            self._sequences = [header.sequence if header else 0 for header in headers]
            self._next = max(self._sequences)
        return self._sequences


def header_of(slot: Slot) -> Header | None:
    """None also where it is damaged."""
    try:
        return slot.header()
    except DamagedFile:
        return None


def _is_same(a: Snapshot, b: Snapshot) -> bool:
    """Whether nothing but voxels has changed between two snapshots of one room."""
    of_a, of_b = ([(kept.object_id, id(kept.mesh), id(kept.place)) for kept in taken.objects] for taken in (a, b))
    return of_a == of_b and a.inventory.owed == b.inventory.owed and state_to_bytes(a.state) == state_to_bytes(b.state)


def _with_moves(room: Room, header: Header, moves: Moves | None) -> Room:
    """The room with its objects where they have been moved to since that save."""
    for moved in moves.moved if moves else ():
        room.objects.move_back(moved.object_id, moved.place)
    room.objects.resume(moves.revision if moves else header.revision, header.owed)
    return room
