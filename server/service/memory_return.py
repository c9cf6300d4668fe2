"""Gives memory that sessions have freed back to the system.

glibc keeps what was freed, for each thread apart: a server of 420 MB grew by 160 after some hundred sessions, and its
files, threads and device memory were as before.
"""

from __future__ import annotations

import asyncio
import contextlib
import ctypes
import sys
from collections.abc import Callable

PAUSE_S = 5.0
"""Between the end of a session and the return; other sessions that end meanwhile share it. It takes up to 20 ms, in
which threads that ask for memory may wait."""


class MemoryReturn:
    """Used on the event loop."""

    def __init__(self, give_back: Callable[[], None] | None = None, pause_s: float = PAUSE_S) -> None:
        """`give_back`: called in a thread; None: as the system's C library does it, if it can."""
        self._give_back = give_back or give_back_freed
        self._pause_s = pause_s
        self._due: asyncio.Task[None] | None = None

    def note_end(self) -> None:
        """A session has ended."""
        if self._due is None or self._due.done():
            self._due = asyncio.create_task(self._wait_and_return())

    def stop(self) -> None:
        """Nothing is given back from now on."""
        if self._due is not None:
            self._due.cancel()

    async def _wait_and_return(self) -> None:
        await asyncio.sleep(self._pause_s)
        await asyncio.to_thread(self._give_back)


def give_back_freed() -> None:
    """Return free pages of all arenas. Does nothing where the C library is not glibc."""
    if sys.platform == "linux":
        with contextlib.suppress(AttributeError):
            ctypes.CDLL(None).malloc_trim(0)
