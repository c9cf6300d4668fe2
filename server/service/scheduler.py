"""Whose frame the device works on next: the session's that has had least of it, one frame of a room at a time.

Start-time fair queuing (Goyal, Vin and Cheng 1996) with measured costs: a session is charged for what its frames took,
so one with heavy frames gets fewer of them and slows only itself. A session that was away comes back with what the
others have had by then, less a little: absence is not saved up.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Hashable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass

CREDIT_S = 0.5
"""Of device time that a session may be behind the others when it comes back: between two frames it is always away."""
AWAY_S = 5.0
"""A session that has not worked for so long does not count among those that share the device."""
_RATE = 0.2  # of a new frame's cost in the running mean


@dataclass(eq=False)
class Share:
    """One session's. Its numbers are the scheduler's to change."""

    room: Hashable
    """Sessions of one room take turns in it."""
    had_s: float = 0.0
    """Device time, virtual where it was away."""
    cost_s: float | None = None
    """Running mean of its frames, without the first, in which kernels are loaded; None before there are any."""
    frames: int = 0
    last_s: float = float("-inf")
    """When it last worked, by the scheduler's clock."""


class Scheduler:
    """For any number of threads."""

    def __init__(self, at_once: int = 1, clock: Callable[[], float] = time.perf_counter) -> None:
        """`at_once`: frames that the device works on side by side."""
        self._at_once = at_once
        self._clock = clock
        self._shares: list[Share] = []
        self._waiting: list[Share] = []
        self._working: list[Share] = []
        self._changed = threading.Condition()

    def join(self, room: Hashable = None) -> Share:
        """A new session, in a room of its own if none is named. It gets no more than the others from now on."""
        share = Share(object() if room is None else room)
        with self._changed:
            share.had_s = self._least_had(share, 0.0)
            self._shares.append(share)
        return share

    def leave(self, share: Share) -> None:
        """The session is over."""
        with self._changed:
            self._shares.remove(share)

    @contextmanager
    def turn(self, share: Share) -> Iterator[float]:
        """Work on a frame; yields how long the session waited for its turn, in seconds."""
        began = self._clock()
        with self._changed:
            share.had_s = max(share.had_s, self._least_had(share, share.had_s) - CREDIT_S)
            self._waiting.append(share)
            self._changed.wait_for(lambda: self._next() is share)
            self._waiting.remove(share)
            self._working.append(share)
            self._changed.notify_all()  # another one may be next where frames are worked on side by side
        started = self._clock()
        try:
            yield started - began
        finally:
            with self._changed:
                self._charge(share, self._clock() - started)
                self._working.remove(share)
                self._changed.notify_all()

    @property
    def busy(self) -> int:
        """Sessions that share the device now."""
        with self._changed:
            return len(self._present())

    def period_s(self, newcomers: int = 0) -> float:
        """Time from one frame of a session to its next if all that are present send as fast as they may.

        `newcomers` are taken to cost as much as the others on average.
        """
        with self._changed:
            costs = [share.cost_s for share in self._present() if share.cost_s is not None]
        mean = sum(costs) / len(costs) if costs else 0.0
        return (sum(costs) + newcomers * mean) / self._at_once

    def _present(self) -> list[Share]:
        now = self._clock()
        return [s for s in self._shares if s in self._working or s in self._waiting or now - s.last_s < AWAY_S]

    def _least_had(self, newcomer: Share, otherwise: float) -> float:
        others = [share.had_s for share in self._present() if share is not newcomer]
        return min(others, default=otherwise)

    def _next(self) -> Share | None:
        """The session whose turn it is, None where all that wait have to."""
        if len(self._working) >= self._at_once:
            return None
        rooms = {share.room for share in self._working}
        able = [share for share in self._waiting if share.room not in rooms]
        return min(able, key=lambda share: share.had_s, default=None)

    def _charge(self, share: Share, spent_s: float) -> None:
        share.had_s += spent_s
        share.frames += 1
        if share.frames == 2:
            share.cost_s = spent_s  # the first foretells nothing
        elif share.cost_s is not None:
            share.cost_s += _RATE * (spent_s - share.cost_s)
        share.last_s = self._clock()
