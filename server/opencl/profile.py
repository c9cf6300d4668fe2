"""The one place for times: device events and host spans, summed under the thesis's row names."""

from __future__ import annotations

import time
from collections import defaultdict
from collections.abc import Iterator
from contextlib import contextmanager

import pyopencl as cl


class Profile:
    """Times of one frame. Device time comes from events; host time of a row counts only what the device did not do."""

    def __init__(self) -> None:
        self.row = "input"
        self._events: list[tuple[str, str, cl.Event]] = []
        self._host_ms: dict[str, float] = defaultdict(float)
        self.reads = self.read_bytes = 0
        """Times that the host has waited for memory since the last `forget`, and their bytes."""

    def add_event(self, kernel: str, event: cl.Event) -> None:
        """Count a launched kernel or copy under the current row."""
        self._events.append((self.row, kernel, event))

    @property
    def launches(self) -> int:
        """Kernels since the last `collect`."""
        return len(self._events)

    def count_read(self, size: int) -> None:
        """The host waits for `size` bytes of the device."""
        self.reads += 1
        self.read_bytes += size

    @contextmanager
    def stage(self, row: str) -> Iterator[None]:
        """Events launched inside count under `row`."""
        outer, self.row = self.row, row
        try:
            yield
        except Exception as error:
            error.add_note(f"in stage {row}")
            raise
        finally:
            self.row = outer

    @contextmanager
    def host(self) -> Iterator[None]:
        """Time spent inside, on the host with nothing queued, counts under the current row."""
        start = time.perf_counter()
        try:
            yield
        finally:
            self._host_ms[self.row] += (time.perf_counter() - start) * 1e3

    def forget(self) -> None:
        """Leave out what a frame that failed has left."""
        self._events.clear()
        self._host_ms.clear()
        self.reads = self.read_bytes = 0

    def collect(self) -> tuple[dict[str, float], dict[str, float]]:
        """Milliseconds per row and per kernel since the last call. Every event must have finished."""
        rows: dict[str, float] = defaultdict(float, self._host_ms)
        kernels: dict[str, float] = defaultdict(float)
        for row, kernel, event in self._events:
            spent_ms = (event.profile.end - event.profile.start) * 1e-6
            rows[row] += spent_ms
            kernels[kernel] += spent_ms
        self.forget()
        return dict(rows), dict(kernels)
