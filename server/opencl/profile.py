"""The one place for times: a frame's wall time by the thesis's row names, and device time by kernel.

While a kernel runs, time counts under the row that launched it (of two at once, the one that began first); while none
runs, under the row that the host is at. So the rows of a frame add up to its wall time, and host work beside a running
kernel costs nothing.
"""

from __future__ import annotations

import time
from bisect import bisect_right
from collections import defaultdict
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import cast

import pyopencl as cl

_TIMES = cl.profiling_info


def clock_s(event: cl.Event, which: int) -> float:
    """One of the event's times (cl.profiling_info) on the device's clock. Ten times as fast as `event.profile`."""
    return cast(int, event.get_profiling_info(which)) * 1e-9


@dataclass(frozen=True)
class _Slice:
    """A launch, or a part of one that was cut (pacing.py)."""

    row: str
    kernel: str
    event: cl.Event
    enqueued_s: float
    """Host clock, just after it was enqueued."""


@dataclass(frozen=True)
class _Interval:
    """When a kernel ran, on the host's clock."""

    slice: _Slice
    begin_s: float
    end_s: float
    """Without the time in which one that began before it was running."""
    device_ms: float
    """All of its time."""


@dataclass(frozen=True)
class FrameTimes:
    """Milliseconds."""

    rows: dict[str, float]
    """They add up to the total."""
    kernels: dict[str, float]
    idle: float
    """In which no kernel ran."""
    total: float


class Profile:
    """Times of one frame."""

    def __init__(self) -> None:
        self.row = "input"
        self._slices: list[_Slice] = []
        self._depth = 0
        self.frame = 0
        """Another number for each frame."""
        self.begin()

    def begin(self) -> None:
        """A frame begins; what one that failed has left is forgotten."""
        self._slices.clear()
        self.frame += 1
        self._began_s = time.perf_counter()
        self._entered: list[tuple[float, str]] = [(self._began_s, self.row)]
        self.launches = 0
        """Kernels launched since then. One that was cut into slices counts once: the count is of the frame, not of how
        busy the machine is."""
        self.reads = self.read_bytes = 0
        """Times that the host has waited for memory since then, and their bytes."""
        self.copies = 0
        """Of memory to, from and on the device since then, waited for or not."""

    def add_event(self, kernel: str, event: cl.Event) -> None:
        """The time of a launch or slice, just enqueued, counts under the current row."""
        self._slices.append(_Slice(self.row, kernel, event, time.perf_counter()))

    @property
    def slices(self) -> int:
        """Of all launches since the frame began; one that was not cut is one."""
        return len(self._slices)

    def count_read(self, size: int) -> None:
        """The host waits for `size` bytes of the device."""
        self.reads += 1
        self.read_bytes += size

    @contextmanager
    def stage(self, row: str) -> Iterator[None]:
        """Kernels launched inside count under `row`; the host's time too, and until the next stage begins."""
        outer, self.row = self.row, row
        self._depth += 1
        self._enter(row)
        try:
            yield
        except Exception as error:
            error.add_note(f"in stage {row}")
            raise
        finally:
            self._depth -= 1
            self.row = outer
            if self._depth > 0:
                self._enter(outer)

    def _enter(self, row: str) -> None:
        self._entered.append((time.perf_counter(), row))

    def collect(self) -> FrameTimes:
        """Times of the frame, which ends with this. Every kernel must have finished."""
        ended_s = time.perf_counter()
        rows: dict[str, float] = defaultdict(float)
        kernels: dict[str, float] = defaultdict(float)
        free_s, busy_s = self._began_s, 0.0
        for one in self._intervals(ended_s):
            self._add_idle(rows, free_s, one.begin_s)
            rows[one.slice.row] += (one.end_s - one.begin_s) * 1e3
            kernels[one.slice.kernel] += one.device_ms
            free_s, busy_s = one.end_s, busy_s + one.end_s - one.begin_s
        self._add_idle(rows, free_s, ended_s)
        total_s = ended_s - self._began_s
        self.begin()
        return FrameTimes(dict(rows), dict(kernels), (total_s - busy_s) * 1e3, total_s * 1e3)

    def _intervals(self, ended_s: float) -> list[_Interval]:
        """When each kernel ran within the frame, in the order in which they began."""
        if not self._slices:
            return []
        events = [one.event for one in self._slices]
        times = [(clock_s(event, _TIMES.START), clock_s(event, _TIMES.END)) for event in events]
        # An event is stamped as queued just before the host reads its own clock, and all have ended by now: the least
        # of these differences is nearest to that of the clocks.
        offsets = [one.enqueued_s - clock_s(one.event, _TIMES.QUEUED) for one in self._slices]
        offset_s = min(*offsets, ended_s - max(device_end_s for _, device_end_s in times))
        found = []
        last_s = self._began_s
        for number in sorted(range(len(times)), key=times.__getitem__):
            device_begin_s, device_end_s = times[number]
            begin_s = min(max(device_begin_s + offset_s, last_s), ended_s)
            last_s = min(max(device_end_s + offset_s, begin_s), ended_s)
            found.append(_Interval(self._slices[number], begin_s, last_s, (device_end_s - device_begin_s) * 1e3))
        return found

    def _add_idle(self, rows: dict[str, float], begin_s: float, end_s: float) -> None:
        """Count the time from `begin_s` to `end_s`, in which no kernel runs, under the rows that the host is at."""
        times = [entered_s for entered_s, _ in self._entered]
        number = max(bisect_right(times, begin_s) - 1, 0)
        while begin_s < end_s:
            until_s = min(times[number + 1], end_s) if number + 1 < len(times) else end_s
            if until_s > begin_s:
                rows[self._entered[number][1]] += (until_s - begin_s) * 1e3
            begin_s, number = max(until_s, begin_s), number + 1
