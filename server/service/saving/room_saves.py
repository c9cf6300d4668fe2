"""The saves of one room: two alternating slots and a placement delta."""

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
from server.service.saving.checksummed_files import DamagedFile
from server.service.saving.placement_delta import PlacementDelta, delete_delta, delta_since, read_delta, write_delta
from server.service.saving.room_snapshots import rebuilt, snapshot
from server.service.saving.room_state import VERSION, Header, state_to_bytes
from server.service.saving.save_slot import SaveSlot
from server.service.saving.snapshot import Snapshot

SLOTS = ("0", "1")
NOTE_USE_S = 60.0
"""Interval between updates of the folder's time stamp while the room is in use."""

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Saved:
    """Cost of a save."""

    written_bytes: int
    """0 if nothing had changed."""
    bricks: int
    lock_ms: float
    """How long the room's lock was held, in which no frame could be processed."""


class RoomSaves:
    """Saves of one room."""

    def __init__(self, name: str, folder: Path) -> None:
        self.name = name
        self.folder = folder
        self.lock = threading.Lock()
        self._slots = [SaveSlot(folder / slot) for slot in SLOTS]
        self._sequences: list[int] | None = None
        self._next = 0
        self._written: Snapshot | None = None
        """Last snapshot written, without bricks."""
        self._delta_lock = threading.Lock()
        self._delta_revision = -1
        """Revision of the objects whose placements are on disk."""
        self._noted_s = float("-inf")

    def note_used(self) -> None:
        """Update the folder's time stamp, which retention uses."""
        self._noted_s = time.monotonic()
        with contextlib.suppress(OSError):  # the room may not have been saved yet
            os.utime(self.folder)

    def save(self, room: Room) -> Saved:
        """Write what has changed. A room that never had a frame or an object is not written."""
        if time.monotonic() - self._noted_s > NOTE_USE_S:
            self.note_used()
        sequences = self._known_sequences()
        if self._has_all(room) or (not any(sequences) and _is_empty(room)):
            return Saved(0, 0, 0.0)
        number = sequences.index(min(sequences))
        taken = snapshot(room, self._slots[number])
        self._next += 1
        size = self._slots[number].write(self._header(taken), taken)
        sequences[number], self._written = self._next, replace(taken, bricks=[], volume=None)
        return Saved(size, sum(len(places) for places, _, _ in taken.bricks), taken.lock_ms)

    def _header(self, taken: Snapshot) -> Header:
        objects = taken.inventory
        return Header(VERSION, self.name, self._next, taken.state.key_digest, objects.revision, objects.pending)

    def save_placements(self, room: Room) -> bool:
        """Save placements only. False if other things have changed since the last save, so that a full one is needed.

        Does not wait for a frame or for a running save.
        """
        with self._delta_lock:
            written, now = self._written, room.objects.inventory()
            delta = delta_since(written.inventory, now) if written else None
            if delta is None:
                return False
            if delta.moved and self._delta_revision != now.revision:
                write_delta(self.folder, delta)
                self._delta_revision = now.revision
            return True

    def _has_all(self, room: Room) -> bool:
        """Whether the newest save is up to date."""
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
                    state, delta = slot.read(), self._delta_after(header)
                    return _with_delta(rebuilt(self.name, state, slot, device), header, delta)
            except DamagedFile as error:
                sequences[number] = 0
                log.warning("a save of room %r is set aside as %s: %s", self.name, slot.quarantine(), error)
        delete_delta(self.folder)
        return None

    def _delta_after(self, header: Header) -> PlacementDelta | None:
        """The placement delta that applies to this save. Raises OSError."""
        try:
            delta = read_delta(self.folder)
        except DamagedFile as error:
            log.warning("objects of room %r are where they were some seconds before: %s", self.name, error)
            return None
        if delta is None or delta.applies_to(header.revision):
            return delta
        delete_delta(self.folder)  # it belongs to a save that no longer exists
        return None

    def key_digest(self) -> bytes | None:
        sequences = self._known_sequences()
        for number in sorted(range(len(SLOTS)), key=lambda number: -sequences[number]):
            try:
                if sequences[number]:
                    return self._slots[number].key_digest()
            except DamagedFile:
                continue  # logged when the room is loaded
        return None

    def _known_sequences(self) -> list[int]:
        """Sequence number of each slot's save; 0 if there is none."""
        if self._sequences is None:
            headers = [header_of(slot) for slot in self._slots]
            self._sequences = [header.sequence if header else 0 for header in headers]
            self._next = max(self._sequences)
        return self._sequences


def header_of(slot: SaveSlot) -> Header | None:
    """The slot's header; None if there is no save or it is damaged."""
    try:
        return slot.header()
    except DamagedFile:
        return None


def _is_empty(room: Room) -> bool:
    """Whether the room has nothing that its first client's `hello` would not make again."""
    objects = room.objects.inventory()
    return room.reconstruction.volume is None and not (objects.has_begun or objects.objects or objects.pending)


def _is_same(a: Snapshot, b: Snapshot) -> bool:
    """Whether two snapshots of one room are equal except for voxels."""
    of_a, of_b = ([(kept.object_id, id(kept.mesh), id(kept.place)) for kept in taken.objects] for taken in (a, b))
    return (
        of_a == of_b
        and a.inventory.pending == b.inventory.pending
        and state_to_bytes(a.state) == state_to_bytes(b.state)
    )


def _with_delta(room: Room, header: Header, delta: PlacementDelta | None) -> Room:
    """Apply the placement delta to a loaded room."""
    for moved in delta.moved if delta else ():
        room.objects.restore_place(moved.object_id, moved.place)
    room.objects.resume(delta.revision if delta else header.revision, header.owed)
    return room
