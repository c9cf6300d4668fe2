"""Limits on accepted connections, in all and per address, before anything is read from them.

A connection is silent while it has not sent what is waited for: a complete request header or, of a WebSocket, the first
message. At a limit, the oldest silent connection makes room for the new one, so that whoever opens many connections and
says nothing keeps nobody out. Connections that are in use are never closed for a new one.
"""

from __future__ import annotations

import logging
import time
from collections import Counter
from collections.abc import Callable

from server.service.edge.connection_limits import network_of
from server.service.limits import Limits

RESERVED_FILES = 256
"""Files and sockets for everything else: saved rooms, kernels, children with their pipes (3 each, one per session)."""
LOG_PERIOD_S = 10.0
"""At most one line of a kind for an address in this time."""
MAX_NOTED_ADDRESSES = 10_000

log = logging.getLogger(__name__)


def max_connections(limits: Limits) -> int:
    """Connections that fit below the limit on open files (RLIMIT_NOFILE). At most half of the files are used."""
    try:
        import resource
    except ImportError:  # Windows has no such limit
        return limits.connections
    files, _ = resource.getrlimit(resource.RLIMIT_NOFILE)
    if files == resource.RLIM_INFINITY:
        return limits.connections
    return max(1, min(limits.connections, files - min(RESERVED_FILES, files // 2)))


class Place:
    """The place of one accepted connection. Must be used on the event loop."""

    def __init__(self, gate: Gate, address: str, network: str) -> None:
        self._gate = gate
        self.address, self.network = address, network
        self.drop: Callable[[], object] = lambda: None
        """Closes the connection at once."""

    def set_silent(self, is_silent: bool) -> None:
        """Note whether something is waited for from this connection."""
        self._gate.set_silent(self, is_silent)

    def leave(self) -> None:
        """The connection is closed. May be called again."""
        self._gate.leave(self)

    def note(self, reason: str) -> None:
        """Log that the connection was closed for `reason`."""
        self._gate.note(self.address, reason)


class Gate:
    """Counts connections. Must be used on the event loop."""

    def __init__(
        self, most: int, most_per_address: int, is_proxy: Callable[[str], bool] = lambda _address: False
    ) -> None:
        """`most` connections in all, of which `most_per_address` from one address, unless it `is_proxy` for others."""
        self._most, self._most_per_address = most, most_per_address
        self._is_proxy = is_proxy
        self._places: set[Place] = set()
        self._counts: Counter[str] = Counter()
        self._silent: dict[str, dict[Place, None]] = {}
        """By network, oldest first."""
        self._notes = SparseLog()

    @property
    def count(self) -> int:
        """Open connections."""
        return len(self._places)

    def enter(self, address: str) -> Place | None:
        """A place for a new connection, which is silent; None if all are in use."""
        network = network_of(address)
        if self._counts[network] >= self._most_per_address and not self._is_proxy(address):
            if not self._make_room(self._silent.get(network)):
                self.note(address, f"it has {self._most_per_address} connections already")
                return None
        elif len(self._places) >= self._most and not self._make_room(
            max(self._silent.values(), key=len, default=None)  # of whoever has most
        ):
            self.note(address, f"all {self._most} connections are taken")
            return None
        place = Place(self, address, network)
        self._places.add(place)
        self._counts[network] += 1
        self.set_silent(place, True)
        return place

    def set_silent(self, place: Place, is_silent: bool) -> None:
        """Put `place` at the end of the silent ones of its network, or take it out of them."""
        silent = self._silent.get(place.network, {})
        if is_silent and place in self._places:
            self._silent.setdefault(place.network, silent).setdefault(place)
        elif place in silent:
            del silent[place]
            if not silent:
                del self._silent[place.network]

    def leave(self, place: Place) -> None:
        """Free `place`. Does nothing if it is free already."""
        if place not in self._places:
            return
        self.set_silent(place, False)
        self._places.discard(place)
        self._counts[place.network] -= 1
        if not self._counts[place.network]:
            del self._counts[place.network]

    def note(self, address: str, reason: str) -> None:
        """Log that a connection of `address` was refused or closed."""
        self._notes.note(address, reason)

    def _make_room(self, silent: dict[Place, None] | None) -> bool:
        """Close the oldest of these. False if there is none."""
        if not silent:
            return False
        oldest = next(iter(silent))
        oldest.note("it was silent, and its place was needed")
        self.leave(oldest)
        oldest.drop()
        return True


class SparseLog:
    """Log of refused connections that an attack does not fill: one line of a kind for a network in LOG_PERIOD_S."""

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self._noted: dict[tuple[str, str], tuple[float, int]] = {}
        """When a line was written last, and how many were left out since."""

    def note(self, address: str, reason: str) -> None:
        """Log a line with the address and the number of lines left out, or count it."""
        key, now_s = (network_of(address), reason), self._clock()
        written_s, left_out = self._noted.pop(key, (-float("inf"), 0))
        if now_s - written_s < LOG_PERIOD_S:
            self._noted[key] = written_s, left_out + 1
            return
        while len(self._noted) >= MAX_NOTED_ADDRESSES:
            del self._noted[next(iter(self._noted))]
        self._noted[key] = now_s, 0
        log.info("connection refused", extra={"address": address, "reason": reason, "unlogged": left_out})
