"""Background thread that saves open rooms every few seconds without stopping their frames."""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable, Iterable

from server.room.room import Room
from server.service.saving.room_saves import Saved
from server.service.saving.room_store import RoomStore, RoomStoreError

EVERY_S = 2.0
"""Time between saves. A crash loses at most this time plus the duration of a save."""
LIMITS_EVERY_S = 60.0

log = logging.getLogger(__name__)


class RoomSaver:
    """Saver of one service. A failed save is logged once; the room stays in memory and the save is retried."""

    def __init__(
        self,
        store: RoomStore,
        rooms: Callable[[], Iterable[Room]],
        every_s: float = EVERY_S,
        on_saved: Callable[[Room, Saved], None] = lambda _room, _saved: None,
        enforce_limits: Callable[[], None] = lambda: None,
    ) -> None:
        """`rooms` returns the open rooms, `on_saved` is called after each save; both in the saver's thread.

        `enforce_limits`: called there at the start and every minute; may raise RoomStoreError.
        """
        self._enforce_limits = enforce_limits
        self._store = store
        self._rooms = rooms
        self._every_s = every_s
        self._on_saved = on_saved
        self._stopped = threading.Event()
        self._thread = threading.Thread(target=self._run, name="probeless-room-saver", daemon=True)
        self.problems: dict[str, str] = {}
        """Reason why the last save failed, one line per room name."""

    def start(self) -> None:
        """Start the thread."""
        self._thread.start()

    def stop(self) -> None:
        """Save all rooms a last time and end the thread; blocks until that is done or has failed."""
        self._stopped.set()
        if self._thread.is_alive():
            self._thread.join()
        self.save_all()

    def save_all(self) -> None:
        """Save all open rooms now."""
        for room in self._rooms():
            self.save(room)

    def save(self, room: Room) -> str | None:
        """Save one room now; the caller keeps it open. Returns why it was not saved, in words for clients, or None."""
        return self._try(room.name, lambda: self._on_saved(room, self._store.save(room)))

    def save_placements(self, room: Room) -> str | None:
        """As `save`, but only object placements, before moves are acknowledged."""
        return self._try(room.name, lambda: self._store.save_placements(room))

    def _try(self, name: str | None, work: Callable[[], None]) -> str | None:
        if name is None:
            return None  # it belongs to one session
        try:
            work()
        except RoomStoreError as error:
            if self.problems.get(name) != str(error):
                log.warning("%s", error)
            self.problems[name] = str(error)
            return error.cause
        if self.problems.pop(name, None) is not None:
            log.info("room %r is saved again", name)
        return None

    def _run(self) -> None:
        tidied_s = float("-inf")
        while not self._stopped.wait(self._every_s):
            try:
                self.save_all()
                if time.monotonic() - tidied_s > LIMITS_EVERY_S:
                    tidied_s = time.monotonic()
                    self._enforce_limits()
            except RoomStoreError as error:
                log.warning("%s", error)
            except Exception:  # a bug must not stop later saves or those of other rooms
                log.exception("rooms could not be saved")
