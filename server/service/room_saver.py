"""Rooms are saved every few seconds, in a thread of their own, while frames go on."""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable, Iterable

from server.room.room import Room
from server.service.room_store import RoomStore, RoomStoreError
from server.service.saving.room_saves import Saved

EVERY_S = 2.0
"""Between saves: with the time that one takes, what a crash may cost."""
TIDY_EVERY_S = 60.0

log = logging.getLogger(__name__)


class RoomSaver:
    """Of one service. A room that cannot be saved is told once, goes on in memory, and is tried again."""

    def __init__(
        self,
        store: RoomStore,
        rooms: Callable[[], Iterable[Room]],
        every_s: float = EVERY_S,
        on_saved: Callable[[Room, Saved], None] = lambda _room, _saved: None,
        tidy: Callable[[], None] = lambda: None,
    ) -> None:
        """`rooms`: those that are open, asked from the saver's thread each time; `on_saved` is called there too.

        `tidy`: called there at first and every minute; may raise RoomStoreError.
        """
        self._tidy = tidy
        self._store = store
        self._rooms = rooms
        self._every_s = every_s
        self._on_saved = on_saved
        self._stopped = threading.Event()
        self._thread = threading.Thread(target=self._run, name="probeless-room-saver", daemon=True)
        self.problems: dict[str, str] = {}
        """By room, one line each: why its last save failed."""

    def start(self) -> None:
        """Begin."""
        self._thread.start()

    def stop(self) -> None:
        """Save all rooms once more and end; returns when they are on the disk, or could not be written."""
        self._stopped.set()
        if self._thread.is_alive():
            self._thread.join()
        self.save_all()

    def save_all(self) -> None:
        """Save all rooms now."""
        for room in self._rooms():
            self.save(room)

    def save(self, room: Room) -> bool:
        """Save one room now, as before it is closed; whether that went well. It must stay open meanwhile."""
        return room.name is None or self._is_done(room.name, lambda: self._on_saved(room, self._store.save(room)))

    def save_moves(self, room: Room) -> bool:
        """Likewise where its objects have been moved to, before that is acknowledged."""
        return room.name is None or self._is_done(room.name, lambda: self._store.save_moves(room))

    def _is_done(self, name: str, work: Callable[[], None]) -> bool:
        try:
            work()
        except RoomStoreError as error:
            if self.problems.get(name) != str(error):
                log.warning("%s", error)
            self.problems[name] = str(error)
            return False
        if self.problems.pop(name, None) is not None:
            log.info("room %r is saved again", name)
        return True

    def _run(self) -> None:
        tidied_s = float("-inf")
        while not self._stopped.wait(self._every_s):
            try:
                self.save_all()
                if time.monotonic() - tidied_s > TIDY_EVERY_S:
                    tidied_s = time.monotonic()
                    self._tidy()
            except RoomStoreError as error:
                log.warning("%s", error)
            except Exception:  # a fault of ours: the other rooms and the next time shall not suffer from it
                log.exception("rooms could not be saved")
