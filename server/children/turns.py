"""Turns of sessions at a few readers, so that one with large files does not keep others waiting.

Whoever has used the readers least goes first. A turn that has lasted a slice is interrupted if somebody who has used
less waits; its work begins again when nobody with less waits. After a few interruptions it is given up.
"""

from __future__ import annotations

import contextlib
import threading
import time
from collections.abc import Callable, Iterator

SLICE_S = 0.2
"""Time that a turn lasts at least: most files take less than 0.1 s."""
MAX_INTERRUPTIONS = 3


class Overdrawn(Exception):
    """This session has used up its time at the readers; a line for its client."""


class Account:
    """Reading time of one session: `burst_s` at once, refilled by `rate` seconds a second."""

    def __init__(self, burst_s: float, rate: float, clock: Callable[[], float] = time.monotonic) -> None:
        self._burst_s, self._rate, self._clock = burst_s, rate, clock
        self._used_s, self._updated_s = 0.0, clock()

    @property
    def used_s(self) -> float:
        """Time used and not yet refilled."""
        now_s = self._clock()
        self._used_s = max(0.0, self._used_s - self._rate * (now_s - self._updated_s))
        self._updated_s = now_s
        return self._used_s

    def spend(self, seconds: float) -> None:
        """Add time that was used."""
        self._used_s = self.used_s + seconds

    def check(self) -> None:
        """Raises Overdrawn if more than the burst is used."""
        over_s = self.used_s - self._burst_s
        if over_s > 0:
            wait_s = over_s / self._rate
            raise Overdrawn(f"this session has used its {self._burst_s:g} s of reading: try again in {wait_s:.0f} s")


class Turn:
    """One use of a reader, in progress or waited for."""

    def __init__(self, turns: Turns, account: Account) -> None:
        self._turns = turns
        self.account = account
        self.began_s = 0.0
        """When it was given, and then when its work began; without meaning while it waits."""
        self.interrupt: Callable[[], object] | None = None
        """Ends the work in progress."""
        self.is_interrupted = False

    def set_interrupt(self, interrupt: Callable[[], object] | None) -> None:
        """The work begins, and `interrupt` ends it; None: it has ended. `interrupt` is not called after that."""
        self._turns.set_interrupt(self, interrupt)


class Turns:
    """Gives turns at `count` readers. Thread-safe."""

    def __init__(self, count: int, clock: Callable[[], float] = time.monotonic, slice_s: float = SLICE_S) -> None:
        self._free, self._clock, self._slice_s = count, clock, slice_s
        self._changed = threading.Condition()
        self._waiting: list[Turn] = []
        """In the order of arrival."""
        self._running: list[Turn] = []

    @property
    def waiting(self) -> int:
        """How many wait."""
        return len(self._waiting)

    @contextlib.contextmanager
    def taken(self, account: Account) -> Iterator[Turn]:
        """Context of one turn. Its time is charged to `account`. Raises Overdrawn."""
        turn = Turn(self, account)
        with self._changed:
            account.check()
            self._waiting.append(turn)
            try:
                while not (self._free and self._first() is turn):
                    self._changed.wait(self._interrupt_for(turn))
            finally:
                self._waiting.remove(turn)
                self._changed.notify_all()
            self._free -= 1
            turn.began_s = self._clock()
            self._running.append(turn)
        try:
            yield turn
        finally:
            with self._changed:
                account.spend(self._clock() - turn.began_s)
                self._running.remove(turn)
                self._free += 1
                self._changed.notify_all()

    def set_interrupt(self, turn: Turn, interrupt: Callable[[], object] | None) -> None:
        """See Turn."""
        with self._changed:
            turn.interrupt = interrupt
            if interrupt is not None:
                turn.account.spend(self._clock() - turn.began_s)
                turn.began_s = self._clock()
            self._changed.notify_all()

    def _first(self) -> Turn:
        return min(self._waiting, key=lambda turn: turn.account.used_s)  # of equal ones, whoever came first

    def _interrupt_for(self, turn: Turn) -> float | None:
        """Interrupt who has used most, if that is due for `turn`. Returns when to look again; None: when told to."""
        if self._first() is not turn or any(running.is_interrupted for running in self._running):
            return None
        now_s = self._clock()
        more = [r for r in self._running if r.interrupt is not None and self._used_s(r, now_s) > turn.account.used_s]
        if not more:
            return self._slice_s if self._running else None
        most = max(more, key=lambda running: self._used_s(running, now_s))
        left_s = most.began_s + self._slice_s - now_s
        if left_s > 0:
            return left_s
        most.is_interrupted = True
        assert most.interrupt is not None
        most.interrupt()
        return None

    @staticmethod
    def _used_s(turn: Turn, now_s: float) -> float:
        return turn.account.used_s + now_s - turn.began_s
