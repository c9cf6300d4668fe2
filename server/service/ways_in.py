"""How to connect to a server, in lines for the person who has started it."""

from __future__ import annotations

import socket
from dataclasses import dataclass

from protocol.local_keys import key_path
from server.service.edge.authenticator import Authenticator, is_loopback
from server.service.edge.tls import Certificate, reachable_host
from server.service.monitoring.qr_code import terminal_code

EVERYWHERE = ("0.0.0.0", "::", "")
AUTHORITY_PATH = "/ca.crt"


def url_of(listener: socket.socket, certificate: Certificate | None = None, everywhere: str = "localhost") -> str:
    """URL for a browser on this machine. If the server listens on all addresses, the host is `everywhere`."""
    host, port = listener.getsockname()[:2]
    if host in EVERYWHERE:
        host = everywhere
    scheme = "http" if certificate is None else "https"
    return f"{scheme}://[{host}]:{port}" if ":" in host else f"{scheme}://{host}:{port}"


@dataclass(frozen=True)
class WaysIn:
    """Of a server that listens."""

    listener: socket.socket
    authenticator: Authenticator
    certificate: Certificate | None
    is_key_left: bool
    """Whether this user's programs on this machine find the token."""
    shows_token: bool

    def lines(self) -> list[str]:
        """For this machine, for others, and what is to be known of the token and the certificate."""
        (host, port), url = self.listener.getsockname()[:2], url_of(self.listener, self.certificate)
        pin = "" if self.certificate is None else f" --tls-fingerprint {self.certificate.fingerprint}"
        is_near = host in EVERYWHERE or is_loopback(host)
        own = url if self.is_key_left and is_near else f"{url}{self._query}{pin}"
        lines = [f"ready: open {url}{self._query} or run: probeless stream SOURCE --server {own}"]
        if host in EVERYWHERE:
            lines.append(f"from other machines: open {self._there}{self._query}")
            lines.append(f"  or run: probeless stream SOURCE --server {self._there}{self._query}{pin}")
        if self.authenticator.token is not None and not self.shows_token:
            where = (
                f"is in {key_path(port)}" if self.is_key_left else "cannot be shown here: give one with --token-file"
            )
            lines.append(f"its token {where}")
        return lines + self._certificate_lines()

    def code(self) -> list[str]:
        """A code that a phone opens the page with; nothing where no other machine reaches it."""
        if self.listener.getsockname()[0] not in EVERYWHERE or not self.shows_token:
            return []
        return ["a phone opens the page with this code:", *terminal_code(f"{self._there}/{self._query.lstrip('/')}")]

    def _certificate_lines(self) -> list[str]:
        if self.certificate is None:
            is_open = self.listener.getsockname()[0] in EVERYWHERE
            return ["browsers of other machines give no camera to a page without https: add --tls"] if is_open else []
        lines = [f"SHA-256 of its certificate: {self.certificate.fingerprint}"]
        if self.certificate.authority is not None:
            lines.append(
                f"browsers warn of it until the device trusts it: open {self._there}{AUTHORITY_PATH} there once and "
                "install what comes as a certificate authority"
            )
        return lines

    @property
    def _query(self) -> str:
        return self.authenticator.query if self.shows_token else ""

    @property
    def _there(self) -> str:
        """The server's URL for other machines."""
        return url_of(self.listener, self.certificate, reachable_host())
