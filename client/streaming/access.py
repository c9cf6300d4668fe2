"""How a program gets into a server: its token, and what vouches for its certificate."""

from __future__ import annotations

import hashlib
import hmac
import ssl
from dataclasses import dataclass
from pathlib import Path
from urllib.parse import parse_qs, urlsplit, urlunsplit

from protocol.local_keys import LocalKey, find_key

STREAM_PATH = "/v1/stream"
TLS_SCHEMES = ("https", "wss")
LOOPBACK = ("localhost", "127.0.0.1", "::1")


class AccessError(ValueError):
    """What was given cannot open anything; one line."""


@dataclass(frozen=True)
class Access:
    """What a user gives besides the server's URL; each may be left out."""

    token: str | None = None
    """None: the URL's own, else the one that a server of the same user on this machine has left."""
    tls_fingerprint: str | None = None
    """SHA-256 of the certificate that the server must show, in hexadecimal."""
    tls_ca: Path | None = None
    """PEM of who must have signed the server's certificate."""


@dataclass(frozen=True)
class Entrance:
    """What a connection is opened with."""

    stream_url: str
    headers: dict[str, str]
    tls: ssl.SSLContext | None


def entrance(server_url: str, access: Access) -> Entrance:
    """Of a server given as `http(s)://host:port[/?token=...]`. Raises AccessError, ValueError where it is no URL."""
    parts = urlsplit(with_scheme(server_url))
    left = _left_here(parts.hostname, parts.port or (443 if parts.scheme in TLS_SCHEMES else 80))
    token = access.token or next(iter(parse_qs(parts.query).get("token", [])), None) or (left.token if left else None)
    tls = None
    if parts.scheme in TLS_SCHEMES:
        tls = tls_context(access, left.fingerprint if left else None)
    elif access.tls_fingerprint is not None or access.tls_ca is not None:
        raise AccessError(f"{without_query(server_url)} is without TLS: give https:// to have its certificate checked")
    headers = {} if token is None else {"Authorization": f"Bearer {token}"}
    return Entrance(stream_url(server_url), headers, tls)


def with_scheme(server_url: str) -> str:
    """The URL of a server that may be given as `host:port`."""
    return server_url if "://" in server_url else f"ws://{server_url}"


def without_query(server_url: str) -> str:
    """The URL less its token, as it may be told to anybody."""
    return server_url.partition("?")[0].removesuffix("/") if "?" in server_url else server_url


def stream_url(server_url: str) -> str:
    """The socket's URL of a server given as `http(s)://host:port`, `ws(s)://host:port[/v1/stream]` or `host:port`."""
    parts = urlsplit(with_scheme(server_url))
    scheme = {"http": "ws", "https": "wss"}.get(parts.scheme, parts.scheme)
    return urlunsplit((scheme, parts.netloc, parts.path if parts.path.strip("/") else STREAM_PATH, "", ""))


def tls_context(access: Access, left_fingerprint: str | None) -> ssl.SSLContext:
    """What checks the server's certificate. Raises AccessError."""
    pinned = access.tls_fingerprint or (left_fingerprint if access.tls_ca is None else None)
    if access.tls_fingerprint is not None and access.tls_ca is not None:
        raise AccessError("--tls-fingerprint and --tls-ca each say what to trust: leave one of the two out")
    if pinned is None:
        try:
            return ssl.create_default_context(cafile=access.tls_ca)
        except (OSError, ValueError) as error:
            why = getattr(error, "reason", None) or getattr(error, "strerror", None) or error
            raise AccessError(f"--tls-ca {access.tls_ca}: cannot be read ({why}): give certificates as PEM") from error
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
    context.check_hostname = False
    context.verify_mode = ssl.CERT_NONE  # by whoever it was made, only this one will do
    context.sslobject_class = _pinned(fingerprint_bytes(pinned))
    return context


def fingerprint_bytes(text: str) -> bytes:
    """32 bytes of a SHA-256 written in hexadecimal, with or without colons. Raises AccessError."""
    try:
        digest = bytes.fromhex(text.lower().removeprefix("sha256:").replace(":", ""))
    except ValueError:
        digest = b""
    if len(digest) != hashlib.sha256().digest_size:
        raise AccessError(f"--tls-fingerprint {text[:100]}: expected SHA-256 in hexadecimal, as the server prints it")
    return digest


def _pinned(digest: bytes) -> type[ssl.SSLObject]:
    """A TLS connection whose handshake fails, before anything is sent, unless the certificate has this SHA-256."""

    class Pinned(ssl.SSLObject):
        def do_handshake(self) -> None:
            super().do_handshake()
            shown = self.getpeercert(binary_form=True)
            if shown is None or not hmac.compare_digest(hashlib.sha256(shown).digest(), digest):
                found = hashlib.sha256(shown or b"").digest().hex(":").upper()
                raise ssl.SSLCertVerificationError(f"its fingerprint is {found}")

    return Pinned


def _left_here(host: str | None, port: int) -> LocalKey | None:
    return find_key(port) if host in LOOPBACK else None
