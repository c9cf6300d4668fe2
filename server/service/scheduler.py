"""Fair scheduling of the device among sessions, with one frame of a room at a time.

Start-time fair queuing (Goyal, Vin and Cheng 1996) with measured costs: the session with the least device time is next.
A session with expensive frames therefore gets fewer of them and slows only itself. A session that was idle continues
from the others' least device time minus a small credit, so idle time cannot be saved up.

A frame that takes long is interrupted: after QUANTUM_S it lets sessions with less device time go first, and then after
each NEXT_QUANTUM_S. Sessions whose frames are short need not wait for that long: they go first once it has taken LONGER
times what theirs take. Other clients of its room wait until it has ended, since it may have changed the room by half.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Hashable, Iterator
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass

CREDIT_S = 0.5
"""Device time that a returning session may be behind the others. Every session is idle between two frames."""
AWAY_S = 5.0
"""A session that is idle for longer is not counted as sharing the device."""
QUANTUM_S = 0.2
"""Time that a frame has before it lets others go first: a usual frame is not interrupted."""
NEXT_QUANTUM_S = 0.1
"""The same for a frame that was interrupted before. With it, and with what is enqueued already (pacing.py), another
session waits for 0.2 s, and for twice as long where the processor has other work too."""
REQUEST_QUANTUM_S = 0.02
"""The same for what is no frame and has time, such as a panorama (0.1 to 0.2 s of a processor)."""
LONGER = 1.5
"""A frame that has taken so many times what another session's frames take in the mean lets it go first. Frames of equal
sessions, which differ by less, do not interrupt each other, and no frame takes more than 1 + 1/LONGER times as long."""
LEAST_QUANTUM_S = 0.02
"""No frame is interrupted before: what waits is due by then, or nearly, and the device is emptied for it."""
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


class Turn:
    """A session's use of the device for one frame; made by Scheduler.acquire."""

    def __init__(self, scheduler: Scheduler, share: SessionShare, quantum_s: float = QUANTUM_S) -> None:
        self._scheduler = scheduler
        self._share = share
        self._quantum_s = quantum_s
        self.waited_s = 0.0
        """Time before the frame could begin."""
        self.spent_s = 0.0
        """Device time of the frame before it was last resumed."""
        self.resumed_s = 0.0
        """When it was begun or last resumed, by the scheduler's clock."""

    @property
    def quantum_s(self) -> float:
        """Time that it has from when it was begun or resumed until it lets others go first."""
        return self._quantum_s if self.spent_s == 0.0 else min(self._quantum_s, NEXT_QUANTUM_S)

    def is_due(self) -> bool:
        """Whether the frame is to let another session go first."""
        return self._scheduler.is_due(self, self._share)

    def give_way(self) -> None:
        """Let others use the device; returns when the frame may go on."""
        with self.released():
            pass

    def released(self) -> AbstractContextManager[None]:
        """Context in which others use the device; the frame goes on after it when it is next."""
        return self._scheduler.released(self, self._share)


class Scheduler:
    """Thread-safe."""

    def __init__(self, concurrent_frames: int = 1, clock: Callable[[], float] = time.perf_counter) -> None:
        """`concurrent_frames`: frames that may run on the device at the same time."""
        self._concurrent_frames = concurrent_frames
        self._clock = clock
        self._shares: list[SessionShare] = []
        self._waiting: list[SessionShare] = []
        self._working: list[SessionShare] = []
        self._interrupted: list[SessionShare] = []
        """Sessions within a frame that let others go first; they wait too."""
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
    def acquire(self, share: SessionShare, quantum_s: float = QUANTUM_S) -> Iterator[Turn]:
        """Context in which the session may use the device. quantum_s: time before it lets others go first."""
        turn, began_s = Turn(self, share, quantum_s), self._clock()
        with self._changed:
            share.used_s = max(share.used_s, self._least_used_s(share, share.used_s) - CREDIT_S)
            self._wait(turn, share)
        turn.waited_s = turn.resumed_s - began_s
        try:
            yield turn
        finally:
            with self._changed:
                self._interrupt(turn, share)
                self._note_frame(share, turn.spent_s)

    def is_due(self, turn: Turn, share: SessionShare) -> bool:
        """Whether the session that has the turn is to let another go first."""
        spent_s = self._clock() - turn.resumed_s
        if spent_s < min(turn.quantum_s, LEAST_QUANTUM_S):
            return False
        with self._changed:
            return any(
                other.used_s < share.used_s + spent_s and spent_s >= _quantum_beside(other, turn.quantum_s)
                for other in self._able()
            )

    @contextmanager
    def released(self, turn: Turn, share: SessionShare) -> Iterator[None]:
        """Context in which the frame of the session that has the turn is interrupted; at its end it waits again."""
        with self._changed:
            self._interrupt(turn, share)
            self._interrupted.append(share)
        try:
            yield
        finally:
            with self._changed:
                self._wait(turn, share)
                self._interrupted.remove(share)

    def _wait(self, turn: Turn, share: SessionShare) -> None:
        """Wait until the session is next, and give it the device."""
        self._waiting.append(share)
        self._changed.wait_for(lambda: self._next() is share)
        self._waiting.remove(share)
        self._working.append(share)
        turn.resumed_s = self._clock()
        self._changed.notify_all()  # with concurrent frames, another session may start too

    def _interrupt(self, turn: Turn, share: SessionShare) -> None:
        """Take the device from the session and charge what it has used."""
        spent_s = self._clock() - turn.resumed_s
        turn.spent_s += spent_s
        self._charge(share, spent_s)
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
        return min(self._able(), key=lambda share: share.used_s, default=None)

    def _able(self) -> list[SessionShare]:
        """Waiting sessions whose rooms no other session's frame is in."""
        rooms = {share.room for share in (*self._working, *self._interrupted)}
        return [share for share in self._waiting if share in self._interrupted or share.room not in rooms]

    def _charge(self, share: SessionShare, spent_s: float) -> None:
        share.used_s += spent_s
        share.last_used_s = self._clock()

    def _note_frame(self, share: SessionShare, cost_s: float) -> None:
        share.frames += 1
        if share.frames == 2:
            share.cost_s = cost_s  # the first frame is not representative
        elif share.cost_s is not None:
            share.cost_s += _RATE * (cost_s - share.cost_s)


def _quantum_beside(other: SessionShare, quantum_s: float) -> float:
    """Time that a frame with that quantum has while a frame of the session `other` waits."""
    if other.cost_s is None:
        return quantum_s
    return min(quantum_s, max(LONGER * other.cost_s, LEAST_QUANTUM_S))
