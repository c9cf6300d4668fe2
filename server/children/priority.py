"""Lower priority for one thread's work beside the frames."""

from __future__ import annotations

import os
import threading

NICENESS = 10
"""Of the thread: the frames' threads have about nine times its share of a busy processor."""


def yield_to_others() -> None:
    """Lower this thread's priority, where the system has one for each thread (Linux)."""
    if hasattr(os, "setpriority") and os.uname().sysname == "Linux":
        os.setpriority(os.PRIO_PROCESS, threading.get_native_id(), NICENESS)
