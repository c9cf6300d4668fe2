"""Writes answers in a thread of its own, in order: the next one is shown while a picture is encoded and written.

The thread yields to others: where client and server share processors, frames do not wait for PNG (20 ms for 640x480).
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from types import TracebackType

from server.children.priority import yield_to_others

MOST_WAITING = 8
"""Frames that wait to be written; more would fill memory (3 MB each at 640x480) where a disk is slow."""


class WriteBehind:
    """Does what it is given, one after the other; a context manager, whose end waits for what has been begun."""

    def __init__(self) -> None:
        self._thread = ThreadPoolExecutor(1, "writer", yield_to_others)
        self._waiting: deque[Future[None]] = deque()

    def begin(self, write: Callable[[], None]) -> None:
        """Have `write` done after what was begun before it."""
        self._waiting.append(self._thread.submit(write))

    def due(self) -> Future[None] | None:
        """What has to be waited for, and its error to be raised, before more is begun; None: nothing."""
        if self._waiting and (self._waiting[0].done() or len(self._waiting) > MOST_WAITING):
            return self._waiting.popleft()
        return None

    def finish(self) -> None:
        """Wait for all that was begun. Raises what writing raised."""
        while self._waiting:
            self._waiting.popleft().result()

    def __enter__(self) -> WriteBehind:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._thread.shutdown(wait=True)
        if error is None:  # or the error before it is the one to tell
            self.finish()
