"""Limits on connections and sessions per client address, so that one client cannot take them all."""

from __future__ import annotations

import contextlib
import ipaddress
from collections import Counter
from collections.abc import Iterator

from server.service.edge.connection import TRY_LATER, Refusal
from server.service.limits import Limits


class ConnectionLimits:
    """Counters per address. Must be used on the event loop."""

    def __init__(self, limits: Limits) -> None:
        self._limits = limits
        self._connections: Counter[str] = Counter()
        self._sessions: Counter[str] = Counter()

    @contextlib.contextmanager
    def connected(self, address: str) -> Iterator[None]:
        """Count one connection for the duration of the context. Raises Refusal at the limit."""
        with _counted(self._connections, address, self._limits.connections_per_address, "connections"):
            yield

    @contextlib.contextmanager
    def capturing(self, address: str) -> Iterator[None]:
        """Count one session for the duration of the context. Raises Refusal at the limit."""
        with _counted(self._sessions, address, self._limits.sessions_per_address, "sessions"):
            yield


@contextlib.contextmanager
def _counted(counts: Counter[str], address: str, most: int, what: str) -> Iterator[None]:
    who = network_of(address)
    if counts[who] >= most:
        raise Refusal(TRY_LATER, f"your address {who} has {most} {what} already, which is the most: end one of them")
    counts[who] += 1
    try:
        yield
    finally:
        counts[who] -= 1
        if not counts[who]:
            del counts[who]


def network_of(address: str) -> str:
    """The unit that is counted: an IPv4 address, or an IPv6 /64 network (one client owns all 2^64 addresses of it)."""
    try:
        found = ipaddress.ip_address(address.partition("%")[0])
    except ValueError:
        return address
    if isinstance(found, ipaddress.IPv4Address):
        return str(found)
    if found.ipv4_mapped is not None:
        return str(found.ipv4_mapped)
    return str(ipaddress.ip_network((found, 64), strict=False))
