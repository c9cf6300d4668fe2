"""Fair scheduling of the device among sessions, with one frame of a room at a time.

Start-time fair queuing (Goyal, Vin and Cheng 1996) with measured costs: the session with the least device time is next.
A session with expensive frames therefore gets fewer of them and slows only itself. A session that was idle continues
from the others' least device time minus a small credit, so idle time cannot be saved up.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Hashable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass

CREDIT_S = 0.5
"""Device time that a returning session may be behind the others. Every session is idle between two frames."""
AWAY_S = 5.0
"""A session that is idle for longer is not counted as sharing the device."""
_RATE = 0.2  # weight of a new frame in the running mean of costs


@dataclass(eq=False)
class SessionShare:
    """One session's share of the device. Changed by the scheduler only."""

    room: Hashable
    """Key of the room. Only one session of a room works at a time."""
    used_s: float = 0.0
    """Virtual device time: time used, raised after idle times."""
    cost_s: float | None = None
    """Running mean cost of a frame (s). Excludes the first frame, which loads kernels; None before the second."""
    frames: int = 0
    last_used_s: float = float("-inf")
    """Time at which its last frame ended, by the scheduler's clock."""


class Scheduler:
    """Thread-safe."""

    def __init__(self, concurrent_frames: int = 1, clock: Callable[[], float] = time.perf_counter) -> None:
        """`concurrent_frames`: frames that may run on the device at the same time."""
        self._concurrent_frames = concurrent_frames
        self._clock = clock
        self._shares: list[SessionShare] = []
        self._waiting: list[SessionShare] = []
        self._working: list[SessionShare] = []
        self._changed = threading.Condition()

    def join(self, room: Hashable = None) -> SessionShare:
        """Register a session; without `room` it has a room of its own. It starts with the others' least device time."""
        share = SessionShare(object() if room is None else room)
        with self._changed:
            share.used_s = self._least_used_s(share, 0.0)
            self._shares.append(share)
        return share

    def leave(self, share: SessionShare) -> None:
        """Remove a session."""
        with self._changed:
            self._shares.remove(share)

    @contextmanager
    def acquire(self, share: SessionShare) -> Iterator[float]:
        """Context in which the session may use the device. Yields the waiting time in seconds."""
        began = self._clock()
        with self._changed:
            share.used_s = max(share.used_s, self._least_used_s(share, share.used_s) - CREDIT_S)
            self._waiting.append(share)
            self._changed.wait_for(lambda: self._next() is share)
            self._waiting.remove(share)
            self._working.append(share)
            self._changed.notify_all()  # with concurrent frames, another session may start too
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
        """Number of sessions that share the device now."""
        with self._changed:
            return len(self._present())

    def period_s(self, newcomers: int = 0) -> float:
        """Predicted frame period of a session if all present sessions send as fast as allowed.

        `newcomers`: additional sessions to assume, each at the mean cost.
        """
        with self._changed:
            costs = [share.cost_s for share in self._present() if share.cost_s is not None]
        mean = sum(costs) / len(costs) if costs else 0.0
        return (sum(costs) + newcomers * mean) / self._concurrent_frames

    def _present(self) -> list[SessionShare]:
        now = self._clock()
        return [s for s in self._shares if s in self._working or s in self._waiting or now - s.last_used_s < AWAY_S]

    def _least_used_s(self, newcomer: SessionShare, otherwise: float) -> float:
        others = [share.used_s for share in self._present() if share is not newcomer]
        return min(others, default=otherwise)

    def _next(self) -> SessionShare | None:
        """The session that works next; None if every waiting session has to wait longer."""
        if len(self._working) >= self._concurrent_frames:
            return None
        rooms = {share.room for share in self._working}
        ready = [share for share in self._waiting if share.room not in rooms]
        return min(ready, key=lambda share: share.used_s, default=None)

    def _charge(self, share: SessionShare, spent_s: float) -> None:
        share.used_s += spent_s
        share.frames += 1
        if share.frames == 2:
            share.cost_s = spent_s  # the first frame is not representative
        elif share.cost_s is not None:
            share.cost_s += _RATE * (spent_s - share.cost_s)
        share.last_used_s = self._clock()
