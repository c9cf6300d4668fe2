"""Authentication: clients need the token, and browser pages must come from the server's own address."""

from __future__ import annotations

import asyncio
import hmac
import ipaddress
import secrets
import socket
from dataclasses import dataclass, field
from pathlib import Path
from urllib.parse import quote, urlsplit

from starlette.requests import HTTPConnection

from server.service.edge.connection import FORBIDDEN, UNAUTHORIZED, Refusal
from server.service.edge.trusted_proxies import TrustedProxies
from server.service.edge.wrong_tokens import WrongTokens

MAX_TOKEN_CHARS = 256
WHERE_IT_IS = "use the URL that the server printed at its start, which ends in ?token=..."


def new_token() -> str:
    """192 random bits, URL-safe."""
    return secrets.token_urlsafe(24)


def is_token(text: str) -> bool:
    """Whether `text` is a valid token: printable ASCII without spaces, so that it fits in a header."""
    return 0 < len(text) <= MAX_TOKEN_CHARS and text.isascii() and text.isprintable() and " " not in text


def token_in(path: Path) -> str:
    """The token in a file, such as a container's secret; white space around it does not count.

    Raises ValueError, one line without the token.
    """
    try:
        text = path.read_text(errors="replace").strip()
    except OSError as error:
        raise ValueError(f"the token's file {path} cannot be read ({error.strerror})") from error
    if not is_token(text):
        raise ValueError(f"{path}: expected a token, up to {MAX_TOKEN_CHARS} ASCII characters without spaces")
    return text


@dataclass(frozen=True)
class Authenticator:
    """Checks the token and the origin of each request. Without a token, only the origin is checked."""

    token: str | None = None
    origins: frozenset[str] = frozenset()
    """Origins of other sites whose pages may use this server, as `https://host:port`."""
    proxies: TrustedProxies = field(default_factory=TrustedProxies, compare=False)
    """Proxies that say from which address a client comes."""
    wrong_tokens: WrongTokens = field(default_factory=WrongTokens, compare=False, repr=False)

    @property
    def query(self) -> str:
        """Query string with the token, for the URL that a browser opens."""
        return "" if self.token is None else f"/?token={quote(self.token, safe='')}"

    def refusal(self, request: HTTPConnection) -> Refusal | None:
        """Why the request is refused; None if it is allowed."""
        origin = request.headers.get("origin")
        if origin is not None and not self._is_ours(origin, request.headers.get("host", "")):
            return Refusal(FORBIDDEN, f"pages of {origin[:60]} may not use this server: see serve --allow-origin")
        given = given_token(request)
        if self.token is None or self.fits(given):
            return None
        return Refusal(UNAUTHORIZED, f"the token is {'missing' if given is None else 'wrong'}: {WHERE_IT_IS}")

    async def slowed_refusal(self, request: HTTPConnection) -> Refusal | None:
        """As `refusal`, after a delay if the token is wrong."""
        refusal = self.refusal(request)
        if refusal is not None and refusal.code == UNAUTHORIZED:
            await self.slow_down(request)
        return refusal

    async def slow_down(self, request: HTTPConnection) -> None:
        """Wait before a refused request is answered, if it holds a wrong token. Others do not wait."""
        if given_token(request) is not None:
            await asyncio.sleep(self.wrong_tokens.delay_s(address_of(request)))

    def fits(self, given: str | None) -> bool:
        """Whether `given` is the token. Compares in constant time."""
        if self.token is None or given is None:
            return False
        return hmac.compare_digest(given.encode(), self.token.encode())

    def shows_metrics_to(self, request: HTTPConnection) -> bool:
        """Metrics are shown to clients with the token and to this machine."""
        return self.token is None or is_loopback(address_of(request)) or self.fits(given_token(request))

    def _is_ours(self, origin: str, host: str) -> bool:
        """Whether `origin` is this server (reached as `host`) or one of the allowed origins."""
        if origin in self.origins:
            return True
        if urlsplit(origin).netloc.lower() != host.lower():
            return False
        # DNS rebinding makes the two equal. The token protects against it; without one, only own names are accepted.
        return self.token is not None or _is_address_or_own_name(urlsplit(f"//{host}").hostname or "")


def given_token(request: HTTPConnection) -> str | None:
    """The token in the request: from the Authorization header or, for a browser's WebSocket, from the URL."""
    scheme, _, token = request.headers.get("authorization", "").partition(" ")
    return token.strip() if scheme.lower() == "bearer" else request.query_params.get("token")


def address_of(request: HTTPConnection) -> str:
    """The client's address; empty if it is not known."""
    return "" if request.client is None else request.client.host


def is_loopback(host: str) -> bool:
    """Whether an address or name is a loopback one, reachable from this machine only."""
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
