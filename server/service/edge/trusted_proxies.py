"""Proxies whose X-Forwarded-For and X-Forwarded-Proto are believed."""

from __future__ import annotations

import ipaddress
from collections.abc import Iterable

Network = ipaddress.IPv4Network | ipaddress.IPv6Network


class TrustedProxies:
    """Networks of proxies. From all other addresses, forwarded headers are ignored."""

    def __init__(self, networks: Iterable[str] = ()) -> None:
        """`networks`: ADDRESS or ADDRESS/BITS, IPv4 or IPv6. Raises ValueError for another text."""
        self._networks: list[Network] = [ipaddress.ip_network(text) for text in networks]

    @property
    def for_uvicorn(self) -> list[str]:
        """The networks for `forwarded_allow_ips`; of IPv4 also as a socket that listens on IPv6 shows them."""
        mapped = [
            f"::ffff:{network.network_address}/{96 + network.prefixlen}"
            for network in self._networks
            if isinstance(network, ipaddress.IPv4Network)
        ]
        return [str(network) for network in self._networks] + mapped

    def __contains__(self, address: str) -> bool:
        try:
            found = ipaddress.ip_address(address.partition("%")[0])
        except ValueError:
            return False
        mapped = found.ipv4_mapped if isinstance(found, ipaddress.IPv6Address) else None
        return any((mapped or found) in network for network in self._networks)

    def __bool__(self) -> bool:
        return bool(self._networks)
