"""Retention of saved rooms: unused rooms expire, and the oldest are deleted when all take too much space."""

from __future__ import annotations

import contextlib
from collections.abc import Collection, Iterator
from dataclasses import dataclass
from pathlib import Path

QUARANTINE_PREFIX = "set-aside-"
"""Name prefix of damaged saves in their room's folder."""
IN_USE_S = 600.0
"""A room that has been idle for less may be open in another process."""
DAY_S = 86400.0


@dataclass(frozen=True)
class RetentionLimits:
    """Limits for all rooms in a folder; None: no limit."""

    space_bytes: int | None = None
    age_s: float | None = None
    """Time for which no client was in the room, while a server was running."""


@dataclass(frozen=True)
class StorageUsage:
    """Disk usage of the folder."""

    rooms: int = 0
    space_bytes: int = 0
    """Includes damaged saves."""
    removed: int = 0
    """Number of deleted items since the start."""


@dataclass(frozen=True)
class StoredItem:
    """A unit of deletion: a room, or one damaged save of a room."""

    folder: Path
    space_bytes: int
    used_s: float
    """Time stamp of the last use, by the system's clock; for the order of items alone."""
    is_room: bool
    idle_s: float = 0.0
    """See IdleTimes."""


def stored_items(folder: Path, skipped: str) -> Iterator[StoredItem]:
    """Items of all rooms in `folder`, except names that begin with `skipped`. Raises OSError."""
    for room in folder.iterdir() if folder.exists() else ():
        if not room.is_dir() or room.name.startswith(skipped):
            continue
        asides = [_piece(aside, is_room=False) for aside in room.glob(f"{QUARANTINE_PREFIX}*")]
        yield from asides
        whole = _piece(room, is_room=True)
        own_bytes = whole.space_bytes - sum(aside.space_bytes for aside in asides)
        if own_bytes:
            yield StoredItem(room, own_bytes, whole.used_s, is_room=True)


def items_to_remove(
    pieces: list[StoredItem], limits: RetentionLimits, in_use: Collection[Path]
) -> Iterator[tuple[StoredItem, str]]:
    """Items to delete, each with the reason: damaged saves first, then rooms, the longest idle first."""
    free = [p for p in pieces if not (p.is_room and (p.folder in in_use or p.idle_s < IN_USE_S))]
    total_bytes = sum(piece.space_bytes for piece in pieces)
    for piece in sorted(free, key=lambda piece: (piece.is_room, -piece.idle_s, piece.used_s)):
        if limits.age_s is not None and piece.idle_s > limits.age_s:
            why = f"not used for {piece.idle_s / DAY_S:.0f} days"
        elif limits.space_bytes is not None and total_bytes > limits.space_bytes:
            why = f"rooms take {total_bytes / 2**20:.0f} MiB, more than {limits.space_bytes / 2**20:.0f}"
        else:
            continue
        total_bytes -= piece.space_bytes
        yield piece, why


def _piece(folder: Path, *, is_room: bool) -> StoredItem:
    used_s, space_bytes = folder.stat().st_mtime, 0
    for path in folder.rglob("*"):
        with contextlib.suppress(FileNotFoundError):  # replaced by a newer save meanwhile
            status = path.stat()
            space_bytes += 0 if path.is_dir() else status.st_size
            if path.parent.parent == folder and QUARANTINE_PREFIX not in path.parent.name:
                used_s = max(used_s, status.st_mtime)
    return StoredItem(folder, space_bytes, used_s, is_room)
