"""How long each saved room has not been used, by the time for which a server has been running on the folder.

The system's clock is not asked: it may be set forward by months, or be wrong after a restart, and rooms would expire.
"""

from __future__ import annotations

import logging
import os
from collections.abc import Callable, Iterable, Iterator
from dataclasses import replace
from pathlib import Path

import msgspec
from msgspec import Struct

from server.service.saving.checksummed_files import DamagedFile, check_file, read_parts, write_parts
from server.service.saving.retention import StoredItem

IDLE, PART = "idle-times", "idle-times.part"
WRITE_EVERY_S = 600.0
"""A restart forgets at most this much of a room's idle time, which only keeps the room longer."""

log = logging.getLogger(__name__)


class _Idle(Struct, array_like=True):
    """One item at the last look."""

    used_s: float
    """Its time stamp. Any other one, also an earlier one, says that it has been used."""
    idle_s: float


class IdleTimes:
    """Idle times of the items in one folder. Not thread-safe."""

    def __init__(self, folder: Path, clock: Callable[[], float]) -> None:
        """`clock`: seconds; never set, like time.monotonic."""
        self._folder = folder
        self._clock = clock
        self._known: dict[str, _Idle] | None = None
        self._looked_s = self._wrote_s = float("-inf")

    def updated(self, items: Iterable[StoredItem]) -> Iterator[StoredItem]:
        """The items with their idle times. Items never seen before have been used just now. Raises OSError."""
        before = self._read() if self._known is None else self._known
        now_s = self._clock()
        passed_s = 0.0 if self._known is None else now_s - self._looked_s
        self._looked_s, self._known = now_s, {}
        for item in items:
            name = item.folder.relative_to(self._folder).as_posix()
            last = before.get(name)
            is_idle = last is not None and last.used_s == item.used_s
            idle_s = last.idle_s + passed_s if last is not None and is_idle else 0.0
            self._known[name] = _Idle(item.used_s, idle_s)
            yield replace(item, idle_s=idle_s)

    def write(self) -> None:
        """Write what `updated` has found, if it was not written of late."""
        if self._known is None or self._clock() - self._wrote_s < WRITE_EVERY_S or not self._folder.exists():
            return
        self._wrote_s = self._clock()
        try:
            write_parts(self._folder / PART, [msgspec.msgpack.encode(self._known)])
            os.replace(self._folder / PART, self._folder / IDLE)
        except OSError as error:
            log.warning("how long rooms have not been used was not saved: %s", error)

    def _read(self) -> dict[str, _Idle]:
        path = self._folder / IDLE
        if not path.exists():
            return {}
        try:
            check_file(path)
            return msgspec.msgpack.decode(next(read_parts(path), b""), type=dict[str, _Idle])
        except (DamagedFile, msgspec.MsgspecError) as error:
            log.warning("all rooms count as used just now: %s", error)
            return {}
