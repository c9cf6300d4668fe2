"""Rate limits of one connection: token buckets for messages and bytes."""

from __future__ import annotations

import time
from collections.abc import Callable

from server.service.limits import MIB, Limits


class TokenBucket:
    """Refills at `rate_per_s` units a second, up to `burst`."""

    def __init__(self, rate_per_s: float, burst: float, clock: Callable[[], float]) -> None:
        self._rate_per_s, self._burst, self._clock = rate_per_s, burst, clock
        self._left = burst
        self._updated_s = clock()

    def spend(self, units: float) -> float:
        """Take units out. Returns the seconds until the bucket is no longer overdrawn, or 0."""
        now = self._clock()
        self._left = min(self._burst, self._left + (now - self._updated_s) * self._rate_per_s) - units
        self._updated_s = now
        return max(0.0, -self._left / self._rate_per_s)


class RateLimiter:
    """Too many messages end the connection. Too many bytes delay reading, which TCP's flow control passes on."""

    def __init__(self, limits: Limits, clock: Callable[[], float] = time.monotonic) -> None:
        self._limits = limits
        self._messages = TokenBucket(limits.messages_per_s, limits.messages_burst, clock)
        self._bytes = TokenBucket(limits.bytes_per_s, limits.bytes_burst, clock)

    def exceeds_message_rate(self) -> bool:
        """Count a message; True if the limit is exceeded."""
        return self._messages.spend(1) > 0

    def pause_s(self, size_bytes: int) -> float:
        """Count a message's bytes. Returns how long to pause reading."""
        return self._bytes.spend(size_bytes)

    @property
    def message_rate_error(self) -> str:
        """Error for a client that sent too many messages."""
        limits = self._limits
        return (
            f"more than {limits.messages_per_s:g} messages a second were sent (saved up: {limits.messages_burst:g}): "
            "send fewer"
        )

    @property
    def byte_rate_notice(self) -> str:
        """Notice for a client that sends too many bytes."""
        return f"more than {self._limits.bytes_per_s / MIB:g} MiB a second were sent: the rest is read more slowly"
