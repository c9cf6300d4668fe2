"""Access to a server: token and verification of its TLS certificate."""

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
    """Access options are invalid; one line."""


@dataclass(frozen=True)
class Access:
    """Access options besides the server's URL."""

    token: str | None = None
    """None: the token of the URL, else the key file of a server of the same user on this machine."""
    tls_fingerprint: str | None = None
    """SHA-256 of the server's certificate in hexadecimal."""
    tls_ca: Path | None = None
    """PEM file of the authority that signed the server's certificate."""


@dataclass(frozen=True)
class ConnectionParameters:
    """Parameters of the WebSocket connection."""

    stream_url: str
    headers: dict[str, str]
    tls: ssl.SSLContext | None


def connection_parameters(server_url: str, access: Access) -> ConnectionParameters:
    """Parameters for `http(s)://host:port[/?token=...]`. Raises AccessError; ValueError if it is not a URL."""
    parts = urlsplit(with_scheme(server_url))
    local = _local_key(parts.hostname, parts.port or (443 if parts.scheme in TLS_SCHEMES else 80))
    token = access.token or next(iter(parse_qs(parts.query).get("token", [])), None) or (local.token if local else None)
    tls = None
    if parts.scheme in TLS_SCHEMES:
        tls = tls_context(access, local.fingerprint if local else None)
    elif access.tls_fingerprint is not None or access.tls_ca is not None:
        raise AccessError(f"{without_query(server_url)} is without TLS: give https:// to have its certificate checked")
    headers = {} if token is None else {"Authorization": f"Bearer {token}"}
    return ConnectionParameters(stream_url(server_url), headers, tls)


def with_scheme(server_url: str) -> str:
    """The URL with a scheme; `host:port` becomes `ws://host:port`."""
    return server_url if "://" in server_url else f"ws://{server_url}"


def without_query(server_url: str) -> str:
    """The URL without its token, for messages."""
    return server_url.partition("?")[0].removesuffix("/") if "?" in server_url else server_url


def stream_url(server_url: str) -> str:
    """The WebSocket URL of a server given as `http(s)://host:port`, `ws(s)://host:port[/v1/stream]` or `host:port`."""
    parts = urlsplit(with_scheme(server_url))
    scheme = {"http": "ws", "https": "wss"}.get(parts.scheme, parts.scheme)
    return urlunsplit((scheme, parts.netloc, parts.path if parts.path.strip("/") else STREAM_PATH, "", ""))


def tls_context(access: Access, local_fingerprint: str | None) -> ssl.SSLContext:
    """TLS context that verifies the server's certificate. Raises AccessError."""
    pinned = access.tls_fingerprint or (local_fingerprint if access.tls_ca is None else None)
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
    context.verify_mode = ssl.CERT_NONE  # the pinned fingerprint is checked instead
    context.sslobject_class = _pinned(fingerprint_bytes(pinned))
    return context


def fingerprint_bytes(text: str) -> bytes:
    """32 bytes of a SHA-256 in hexadecimal, with or without colons. Raises AccessError."""
    try:
        digest = bytes.fromhex(text.lower().removeprefix("sha256:").replace(":", ""))
    except ValueError:
        digest = b""
    if len(digest) != hashlib.sha256().digest_size:
        raise AccessError(f"--tls-fingerprint {text[:100]}: expected SHA-256 in hexadecimal, as the server prints it")
    return digest


def _pinned(digest: bytes) -> type[ssl.SSLObject]:
    """A TLS class whose handshake fails before any data is sent, unless the certificate has this SHA-256."""

    class Pinned(ssl.SSLObject):
        def do_handshake(self) -> None:
            super().do_handshake()
            certificate = self.getpeercert(binary_form=True)
            if certificate is None or not hmac.compare_digest(hashlib.sha256(certificate).digest(), digest):
                found = hashlib.sha256(certificate or b"").digest().hex(":").upper()
                raise ssl.SSLCertVerificationError(f"its fingerprint is {found}")

    return Pinned


def _local_key(host: str | None, port: int) -> LocalKey | None:
    return find_key(port) if host in LOOPBACK else None
