"""Keeps a device answerable: long launches are enqueued in slices, and few of them ahead of the device.

A device runs what is enqueued to its end, whoever waits. So that another session waits for a slice at most and not for
a whole frame, a launch that may be long is cut along its slowest dimension, and the host enqueues the next slice only
once what is on the device will soon have ended. Between two launches or slices it asks `yielding` whether to let others
use the device; while kernels are compiled, others have it. Each work-item runs once and does what it would have done:
results are the same to the bit.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass
from typing import Protocol

import pyopencl as cl

from server.opencl.profile import clock_s

Size = tuple[int, ...]

SLICE_S, SHARED_SLICE_S = 0.05, 0.02
"""Longest slice; the second where others may want the device. Most launches of a usual frame are shorter."""
AHEAD_S, SHARED_AHEAD_S = 0.05, 0.02
"""What may be enqueued ahead of the device, by expected time: enough for it never to wait for the host. One slice more
may be there, and all of it runs before another session has the device."""
STEP_S = 20e-9
"""Time of one step of one work-item on two cores of a processor, before a kernel's own is known, and at least this
even where it was faster: a kernel that found nothing to do in one frame may find it in the next. Measured: 10 to 90 ns
for a ray of transfer or a pixel of the ray cast. On a GPU it is less, which only cuts long launches into more slices.
"""
PROBE = 1 / 16
"""Share of a slice that the first one of a kernel has whose steps were never timed, where others may want the device:
they may take 50 times STEP_S."""
TELLING = 1 / 20
"""A slice that took less than this share of the longest says more of its launch than of its steps: these took at most
what it says. So it counts only where that is less than is known already; else a kernel that was held up once would stay
in slices too short to tell otherwise. Less than PROBE: the first slice of a long launch always counts."""
_FADING = 0.95
"""The longest time of a kernel's step is remembered with this factor a launch."""


class Yielding(Protocol):
    """Who else wants the device."""

    def is_due(self) -> bool:
        """Whether others are to use the device now. Asked before each launch and slice: takes no time."""

    def give_way(self) -> None:
        """Called while the device has nothing of this frame; returns when the frame may go on. May raise to end it."""

    def released(self) -> AbstractContextManager[None]:
        """Context in which the frame leaves the device to others."""


@dataclass
class _StepTime:
    """Seconds of one step of one work-item of a kernel."""

    longest_s: float
    usual_s: float


class StepTimes:
    """What steps of kernels took, on one device: a new session's launches are cut by what others' took. Any thread may
    ask and add; where two add at once, one of them may not count."""

    def __init__(self) -> None:
        self._times: dict[str, _StepTime] = {}

    def of(self, kernel: str) -> _StepTime | None:
        """None: it was never timed."""
        return self._times.get(kernel)

    def add(self, kernel: str, step_s: float) -> None:
        """A slice's steps took so long each."""
        known = self._times.get(kernel)
        if known is None:
            self._times[kernel] = _StepTime(step_s, step_s)
        else:
            known.longest_s = max(step_s, _FADING * known.longest_s)
            known.usual_s += 0.25 * (step_s - known.usual_s)


@dataclass(frozen=True)
class _Enqueued:
    kernel: str
    steps: int
    """Of all its work-items."""
    expected_s: float
    event: cl.Event


class Pacer:
    """Belongs to a command queue."""

    def __init__(
        self,
        slice_s: float = SLICE_S,
        ahead_s: float = AHEAD_S,
        step_s: float = STEP_S,
        times: StepTimes | None = None,
    ) -> None:
        """`times`: of the device; None: those of this queue alone."""
        self._alone_slice_s, self._alone_ahead_s, self._step_s = slice_s, ahead_s, step_s
        self._times = times or StepTimes()
        self._ahead: deque[_Enqueued] = deque()
        self._expected_s = 0.0
        """Of all that is ahead."""
        self.yielding: Yielding | None = None
        """None: the frame has the device for itself."""

    @property
    def _slice_s(self) -> float:
        return self._alone_slice_s if self.yielding is None else min(self._alone_slice_s, SHARED_SLICE_S)

    @property
    def _ahead_s(self) -> float:
        return self._alone_ahead_s if self.yielding is None else min(self._alone_ahead_s, SHARED_AHEAD_S)

    def slices(self, kernel: str, size: Size, local: Size, steps: int) -> Iterable[tuple[Size, Size]]:
        """Offset and size of each slice of a launch, in work-items; `size` and all slices are multiples of `local`.

        `steps`: inner steps of a work-item, such as rays. Waits before each slice while too much is enqueued already.
        """
        if self._fits(kernel, math.prod(size) * steps):
            return (((0,) * len(size), size),)
        is_long = math.prod(size) * steps * self._step_s > PROBE * self._slice_s
        may_hold = is_long and self.yielding is not None
        return cut(size, local, lambda: self._most_items(kernel, steps, may_hold))

    def _fits(self, kernel: str, steps: int) -> bool:
        """Whether a launch of so many steps is one slice that waits for nobody, without a look at the device."""
        time = self._times.of(kernel)
        if time is None or self._expected_s > self._ahead_s or (self.yielding is not None and self.yielding.is_due()):
            return False
        return steps * max(time.longest_s, self._step_s) <= self._slice_s

    def settle(self) -> None:
        """Learn from what the device has done. At the end of a frame; launches that fit do not ask."""
        while self._ahead and self._ahead[0].event.command_execution_status == cl.command_execution_status.COMPLETE:
            self._learn(self._next())

    def _most_items(self, kernel: str, steps: int, may_hold: bool) -> int:
        """Work-items of the next slice, once there is room for one. What earlier slices took counts at once: a launch
        may last minutes, in which others begin to use the processor."""
        self._make_room()
        if may_hold and self._times.of(kernel) is None and any(one.kernel == kernel for one in self._ahead):
            self._drain(0.0)
        time = self._times.of(kernel)
        slice_s = PROBE * self._slice_s if may_hold and time is None else self._slice_s
        step_s = self._step_s if time is None else max(time.longest_s, self._step_s)
        return max(int(slice_s / (step_s * steps)), 1)

    def enqueued(self, kernel: str, items: int, steps: int, event: cl.Event) -> None:
        """A slice of so many work-items was enqueued."""
        time = self._times.of(kernel)
        usual_s = time.usual_s if time else self._step_s
        one = _Enqueued(kernel, items * steps, items * steps * usual_s, event)
        self._ahead.append(one)
        self._expected_s += one.expected_s

    @contextmanager
    def aside(self) -> Iterator[None]:
        """Context for what takes the host long, such as compiling: others may use the device meanwhile."""
        if self.yielding is None:
            yield
            return
        self._drain(0.0)
        with self.yielding.released():
            yield

    def _make_room(self) -> None:
        self.settle()
        if self.yielding is not None and self.yielding.is_due():
            self._drain(0.0)
            self.yielding.give_way()
        self._drain(self._ahead_s)

    def _drain(self, ahead_s: float) -> None:
        """Wait until no more than so much is on the device; 0: nothing."""
        while self._ahead and (ahead_s == 0.0 or self._expected_s > ahead_s):
            one = self._next()
            one.event.wait()
            self._learn(one)

    def _next(self) -> _Enqueued:
        """What the device does next, which no longer counts as ahead."""
        one = self._ahead.popleft()
        self._expected_s = self._expected_s - one.expected_s if self._ahead else 0.0
        return one

    def _learn(self, one: _Enqueued) -> None:
        started_s, ended_s = (clock_s(one.event, which) for which in (cl.profiling_info.START, cl.profiling_info.END))
        step_s = (ended_s - started_s) / one.steps
        known = self._times.of(one.kernel)
        bound_s = self._step_s if known is None else max(known.longest_s, self._step_s)
        if ended_s - started_s >= TELLING * self._slice_s or step_s <= bound_s:
            self._times.add(one.kernel, step_s)


def cut(size: Size, local: Size, most_items: Callable[[], int]) -> Iterator[tuple[Size, Size]]:
    """Offset and size of parts of a launch with at most `most_items()` work-items each, where a work-group has no more.

    It is asked for each part anew. A part is whole in the fastest dimensions as far as that is possible.
    """
    at = [0] * len(size)
    while at[-1] < size[-1]:
        part = _next_part(size, local, at, most_items())
        yield tuple(at), part
        for axis, extent in enumerate(part):
            at[axis] += extent
            if at[axis] < size[axis] or axis == len(size) - 1:
                break
            at[axis] = 0


def _next_part(size: Size, local: Size, at: list[int], most_items: int) -> Size:
    part = list(local)
    for axis, group in enumerate(local):
        groups = max(most_items // math.prod(part), 1)
        part[axis] = min(groups * group, size[axis] - at[axis])
        if part[axis] < size[axis]:
            break
    return tuple(part)
