"""Ctrl-C as a wish to end in order, for sources that have no end: the first is noted, the second interrupts."""

from __future__ import annotations

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType


@contextmanager
def stop_on_interrupt(wanted: bool = True) -> Iterator[threading.Event]:
    """An event that the first Ctrl-C sets; the second raises KeyboardInterrupt, as every one does unless `wanted`."""
    stopping = threading.Event()
    if not wanted or threading.current_thread() is not threading.main_thread():
        yield stopping
        return

    def note(_signal: int, _frame: FrameType | None) -> None:
        if stopping.is_set():
            raise KeyboardInterrupt
        stopping.set()

    before = signal.signal(signal.SIGINT, note)
    try:
        yield stopping
    finally:
        signal.signal(signal.SIGINT, before)
