"""How many rooms each client address may have opened, so that one client cannot take all places."""

from __future__ import annotations

import ipaddress
import time
from collections.abc import Callable, Collection

from server.service.edge.connection_limits import network_of
from server.service.edge.trusted_proxies import TrustedProxies

SETTLING_S = 30.0
"""A room is counted from when it was asked for, though it takes this long at most until it is listed."""


class Quota:
    """Counts the open rooms by who opened them."""

    def __init__(self, most: int, clock: Callable[[], float] = time.monotonic) -> None:
        """`most`: rooms of one client."""
        self.most = most
        self._clock = clock
        self._opened: dict[str, tuple[str, float]] = {}
        """Client and time, by room."""

    def claim(self, room_id: str, client: str, open_ids: Collection[str]) -> bool:
        """Whether this client may open this room; it is counted if so. `open_ids`: all rooms that are open now.

        An empty `client` is not limited: nothing tells it from others.
        """
        now_s = self._clock()
        self._opened = {
            room: (who, when_s)
            for room, (who, when_s) in self._opened.items()
            if room in open_ids or now_s - when_s < SETTLING_S
        }
        if room_id in self._opened or not client:
            return True
        if sum(who == client for who, _ in self._opened.values()) >= self.most:
            return False
        self._opened[room_id] = client, now_s
        return True

    def release(self, room_id: str) -> None:
        """The room is closed."""
        self._opened.pop(room_id, None)


def client_of(address: str, proxies: TrustedProxies) -> str:
    """What a client is counted by: its address, or its network of 64 bits in IPv6. Empty where that is not known.

    `address` is the peer's or, where the peer is one of the `proxies`, what that says. Without named proxies an address
    of this machine or of a private network may be a proxy's, which is the same for everybody.
    """
    try:
        found = ipaddress.ip_address(address.partition("%")[0])
    except ValueError:
        return ""
    if address in proxies or (not proxies and (found.is_private or found.is_loopback)):
        return ""
    return network_of(address)
