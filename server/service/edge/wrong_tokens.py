"""Delay of answers to wrong tokens, so that tokens cannot be guessed quickly."""

from __future__ import annotations

import time
from collections.abc import Callable

from server.service.edge.connection_limits import network_of

FREE_ATTEMPTS = 5
"""Wrong tokens that are answered at once, for people who mistype."""
FIRST_DELAY_S, MAX_DELAY_S = 0.25, 8.0
FORGOTTEN_S = 30.0
"""Time after which one wrong token is forgotten."""
MAX_COUNT = 20
"""More wrong tokens count as this many: an address is as new after ten minutes at the latest."""
MAX_ADDRESSES = 10_000


class WrongTokens:
    """Wrong tokens by address (IPv6: by /64 network). Must be used on the event loop."""

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self._counts: dict[str, tuple[float, float]] = {}
        """Wrong tokens that are not forgotten, and when that was worked out; the latest address is the last."""

    def delay_s(self, address: str) -> float:
        """Count a wrong token of `address`. Returns the delay of its answer: doubles, up to MAX_DELAY_S."""
        who, now_s = network_of(address), self._clock()
        before, counted_s = self._counts.pop(who, (0.0, now_s))
        count = min(max(0.0, before - (now_s - counted_s) / FORGOTTEN_S) + 1, MAX_COUNT)
        while len(self._counts) >= MAX_ADDRESSES:
            del self._counts[next(iter(self._counts))]
        self._counts[who] = count, now_s
        if count <= FREE_ATTEMPTS:
            return 0.0
        return float(min(FIRST_DELAY_S * 2.0 ** max(count - FREE_ATTEMPTS - 1, 0.0), MAX_DELAY_S))
