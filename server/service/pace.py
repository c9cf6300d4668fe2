"""How fast one connection may send: allowances that fill up with time and are spent by what comes."""

from __future__ import annotations

import time
from collections.abc import Callable

from server.service.limits import MIB, Limits


class Allowance:
    """So many units a second, of which some may be saved up."""

    def __init__(self, per_s: float, at_once: float, clock: Callable[[], float]) -> None:
        self._per_s, self._at_once, self._clock = per_s, at_once, clock
        self._left = at_once
        self._then = clock()

    def spend(self, units: float) -> float:
        """Take units out; the seconds until it is no longer overdrawn, 0 where it is not."""
        now = self._clock()
        self._left = min(self._at_once, self._left + (now - self._then) * self._per_s) - units
        self._then = now
        return max(0.0, -self._left / self._per_s)


class Pace:
    """Of one connection: too many messages end it; too many bytes are only read later, which TCP passes on."""

    def __init__(self, limits: Limits, clock: Callable[[], float] = time.monotonic) -> None:
        self._limits = limits
        self._messages = Allowance(limits.messages_per_s, limits.messages_at_once, clock)
        self._bytes = Allowance(limits.bytes_per_s, limits.bytes_at_once, clock)

    def is_flooded_by_one_more(self) -> bool:
        """Count a message; True where it is one too many."""
        return self._messages.spend(1) > 0

    def pause_s(self, size_bytes: int) -> float:
        """Count a message's bytes; how long to read nothing."""
        return self._bytes.spend(size_bytes)

    @property
    def flooded(self) -> str:
        """The line for who sent too many messages."""
        limits = self._limits
        return (
            f"more than {limits.messages_per_s:g} messages a second were sent (saved up: {limits.messages_at_once:g}): "
            "send fewer"
        )

    @property
    def slowed(self) -> str:
        """The line for who sends too many bytes."""
        return f"more than {self._limits.bytes_per_s / MIB:g} MiB a second were sent: the rest is read more slowly"
