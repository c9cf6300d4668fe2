"""Who may come in: whoever has the token; and from a browser, only pages of the server's own address."""

from __future__ import annotations

import hmac
import ipaddress
import secrets
import socket
from dataclasses import dataclass
from urllib.parse import quote, urlsplit

from starlette.requests import HTTPConnection

from server.service.connection import FORBIDDEN, UNAUTHORIZED, Refusal

MAX_TOKEN_CHARS = 256
WHERE_IT_IS = "use the URL that the server printed at its start, which ends in ?token=..."


def new_token() -> str:
    """192 random bits, as they stand in a URL."""
    return secrets.token_urlsafe(24)


def is_token(text: str) -> bool:
    """Whether it can be one: it must pass through a header."""
    return 0 < len(text) <= MAX_TOKEN_CHARS and text.isascii() and text.isprintable() and " " not in text


@dataclass(frozen=True)
class Authenticator:
    """What the server asks of whoever connects. The one without a token asks nothing of programs."""

    token: str | None = None
    origins: frozenset[str] = frozenset()
    """Of pages elsewhere that may use this server, as `https://host:port`."""

    @property
    def query(self) -> str:
        """What the URL that lets a browser in ends with."""
        return "" if self.token is None else f"/?token={quote(self.token, safe='')}"

    def refusal(self, request: HTTPConnection) -> Refusal | None:
        """Why this client must stay outside; None: it may come in."""
        origin = request.headers.get("origin")
        if origin is not None and not self._is_ours(origin, request.headers.get("host", "")):
            return Refusal(FORBIDDEN, f"pages of {origin[:60]} may not use this server: see serve --allow-origin")
        given = given_token(request)
        if self.token is None or self.fits(given):
            return None
        return Refusal(UNAUTHORIZED, f"the token is {'missing' if given is None else 'wrong'}: {WHERE_IT_IS}")

    def fits(self, given: str | None) -> bool:
        """Whether this is the token, in a time that does not tell how much of it is right."""
        if self.token is None or given is None:
            return False
        return hmac.compare_digest(given.encode(), self.token.encode())

    def shows_metrics_to(self, request: HTTPConnection) -> bool:
        """To whoever has the token, and to this machine."""
        address = "" if request.client is None else request.client.host
        return self.token is None or is_loopback(address) or self.fits(given_token(request))

    def _is_ours(self, origin: str, host: str) -> bool:
        """Whether a page of `origin` came from this server, which it asked for as `host`, or is allowed by name."""
        if origin in self.origins:
            return True
        if urlsplit(origin).netloc.lower() != host.lower():
            return False
        # A name that an attacker lets point here makes the two equal; with a token that gains nothing.
        return self.token is not None or _is_address_or_own_name(urlsplit(f"//{host}").hostname or "")


def given_token(request: HTTPConnection) -> str | None:
    """What the client says is the token: in the header, or in the URL, as a browser's WebSocket must."""
    scheme, _, token = request.headers.get("authorization", "").partition(" ")
    return token.strip() if scheme.lower() == "bearer" else request.query_params.get("token")


def is_loopback(host: str) -> bool:
    """Whether an address or name is this machine's own, reachable from nowhere else."""
    if host.lower().rstrip(".") == "localhost":
        return True
    address = _address(host)
    if isinstance(address, ipaddress.IPv6Address) and address.ipv4_mapped is not None:
        address = address.ipv4_mapped
    return address is not None and address.is_loopback


def _is_address_or_own_name(host: str) -> bool:
    names = {"localhost", socket.gethostname().lower()}
    return _address(host) is not None or host.lower() in names or host.lower().endswith(".localhost")


def _address(host: str) -> ipaddress.IPv4Address | ipaddress.IPv6Address | None:
    try:
        return ipaddress.ip_address(host)
    except ValueError:
        return None
