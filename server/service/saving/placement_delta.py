"""Object placements that have changed since a room's save: a small file, written before a move is acknowledged."""

from __future__ import annotations

import os
from pathlib import Path

import msgspec
import numpy as np
from msgspec import Struct, field
from numpy.typing import NDArray

from server.room.room_objects import Inventory, Place
from server.scene.placement import Placement
from server.service.saving.checksummed_files import DamagedFile, check_file, read_parts, sync_folder, write_parts
from server.service.saving.room_state import array_from_list, array_to_list

VERSION = 1
MOVES, PART = "moves", "moves.part"


class MovedObject(Struct, frozen=True, forbid_unknown_fields=True):
    """One moved object. Exactly one of the two placements is set."""

    object_id: str
    world_from_model: NDArray[np.float64] | None = None
    placement: Placement | None = field(default=None, name="asked")

    @property
    def place(self) -> Place:
        """The object's placement."""
        return self.world_from_model if self.world_from_model is not None else self.placement or Placement()


class PlacementDelta(Struct, frozen=True, forbid_unknown_fields=True):
    """All objects that have moved since the save with revision `since`."""

    version: int
    since: int
    revision: int
    """Revision of the objects with these placements."""
    moved: tuple[MovedObject, ...]

    def applies_to(self, revision: int) -> bool:
        """Whether the delta can be applied to a save of that revision: same objects, and not newer."""
        return self.since <= revision <= self.revision


def delta_since(saved: Inventory, now: Inventory) -> PlacementDelta | None:
    """The moves between two inventories; None if anything but placements has changed."""
    if saved.has_begun != now.has_begun or saved.pending != now.pending or len(saved.objects) != len(now.objects):
        return None
    pairs = list(zip(saved.objects, now.objects, strict=True))
    if any(was.object_id != kept.object_id or was.mesh is not kept.mesh for was, kept in pairs):
        return None
    moved = tuple(_moved(kept.object_id, kept.place) for was, kept in pairs if was.place is not kept.place)
    return PlacementDelta(VERSION, saved.revision, now.revision, moved)


def _moved(object_id: str, place: Place) -> MovedObject:
    if isinstance(place, Placement):
        return MovedObject(object_id, placement=place)
    return MovedObject(object_id, world_from_model=place)


def write_delta(folder: Path, moves: PlacementDelta) -> None:
    """Replace the delta file atomically. Raises OSError; the previous file is then unchanged."""
    write_parts(folder / PART, [msgspec.msgpack.encode(moves, enc_hook=array_to_list)])
    os.replace(folder / PART, folder / MOVES)
    sync_folder(folder)


def read_delta(folder: Path) -> PlacementDelta | None:
    """None if there is no delta file. Raises DamagedFile, OSError."""
    path = folder / MOVES
    if not path.exists():
        return None
    check_file(path)
    try:
        moves = msgspec.msgpack.decode(next(read_parts(path), b""), type=PlacementDelta, dec_hook=array_from_list)
    except msgspec.MsgspecError as error:
        raise DamagedFile(f"{path} holds no moves: {error}") from error
    if moves.version != VERSION:
        raise DamagedFile(f"{path} is of version {moves.version}, this program reads {VERSION}")
    return moves


def delete_delta(folder: Path) -> None:
    """Delete the delta file if there is one. Raises OSError."""
    if (folder / MOVES).exists():
        (folder / MOVES).unlink()
