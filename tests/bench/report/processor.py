"""Processor time of a piece of work, of this process and of those that it has started."""

from __future__ import annotations

import os
import time
from collections.abc import Iterator
from pathlib import Path

PROC = Path("/proc")
"""Of Linux; where there is none, other processes do not count."""


class ProcessorTime:
    """Counts from when it is made. Processes that end meanwhile do not count."""

    def __init__(self) -> None:
        self._others = _others_s()
        self._own_s = time.process_time()

    def ms(self) -> float:
        """Milliseconds until now, of all threads."""
        own_s, others = time.process_time() - self._own_s, _others_s()
        return 1e3 * (own_s + sum(spent_s - self._others.get(pid, 0.0) for pid, spent_s in others.items()))


def _others_s() -> dict[int, float]:
    """Seconds by process."""
    return {pid: spent_s for pid in _descendants(os.getpid()) if (spent_s := _spent_s(pid)) is not None}


def _descendants(pid: int) -> Iterator[int]:
    for children in (PROC / str(pid) / "task").glob("*/children"):
        try:
            found = [int(child) for child in children.read_text().split()]
        except OSError:  # the thread has ended
            continue
        for child in found:
            yield child
            yield from _descendants(child)


def _spent_s(pid: int) -> float | None:
    """None: it has ended."""
    spent_ns = 0
    try:
        for thread in (PROC / str(pid) / "task").iterdir():
            spent_ns += int((thread / "schedstat").read_text().split()[0])
    except OSError:
        return None
    return 1e-9 * spent_ns
