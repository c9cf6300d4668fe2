"""Options of `probeless serve`: access, TLS certificate, limits and folders."""

from __future__ import annotations

import logging
import os
import tempfile
import threading
from dataclasses import dataclass, replace
from pathlib import Path
from typing import cast, get_args
from urllib.parse import urlsplit

from platformdirs import user_data_path

from client.errors import OptionError, RunError
from server.service.edge.authenticator import MAX_TOKEN_CHARS, Authenticator, is_loopback, is_token, new_token, token_in
from server.service.edge.tls import Certificate, CertificateError, given_certificate, own_certificate
from server.service.edge.trusted_proxies import TrustedProxies
from server.service.limits import DEFAULT_LIMITS, GIB, MIB, Limits
from server.service.monitoring.event_log import LogFormat
from server.service.saving.retention import DAY_S, RetentionLimits

log = logging.getLogger(__name__)

NO_TOKEN = "none"
NO_DATA = "none"
EXIT_TIMEOUT_S = 3.0
LEAST_VOLUME_MIB, MOST_VOLUME_MIB = 16, 1 << 20


@dataclass(frozen=True)
class ServeOptions:
    """Options as typed; None: not given."""

    host: str
    token: str | None = None
    token_file: Path | None = None
    insecure: bool = False
    allow_origin: tuple[str, ...] = ()
    trusted_proxy: tuple[str, ...] = ()
    tls: bool = False
    tls_cert: Path | None = None
    tls_key: Path | None = None
    volume_memory: int | None = None
    """MiB."""
    sessions: int | None = None
    sessions_per_address: int | None = None
    data_gib: float | None = None
    data_days: float | None = None
    new_token: str | None = None
    """Where none is given: the one that an earlier server made up, which this one takes the place of."""


def authenticator_of(options: ServeOptions) -> Authenticator:
    """Raises OptionError."""
    origins = frozenset(_origin(text) for text in options.allow_origin)
    proxies = _proxies(options.trusted_proxy)
    if options.token_file is not None:
        return Authenticator(_token_in_file(options), origins, proxies)
    if options.token == NO_TOKEN:
        if not (options.insecure or is_loopback(options.host)):
            raise OptionError(
                f"--token none lets in everybody who reaches {options.host}: leave it out, or add --insecure if that "
                "is meant, say behind a proxy that asks who comes"
            )
        return Authenticator(None, origins, proxies)
    if options.insecure:
        raise OptionError("--insecure goes with --token none: leave it out")
    if options.token is not None and not is_token(options.token):
        raise OptionError(f"--token: expected up to {MAX_TOKEN_CHARS} ASCII characters without spaces, or none")
    return Authenticator(options.token or options.new_token or new_token(), origins, proxies)


def _token_in_file(options: ServeOptions) -> str:
    if options.token is not None:
        raise OptionError("--token (PROBELESS_TOKEN) and --token-file (PROBELESS_TOKEN_FILE) are both given: give one")
    if options.insecure:
        raise OptionError("--insecure goes with --token none: leave it out")
    assert options.token_file is not None
    try:
        return token_in(options.token_file)
    except ValueError as error:
        raise OptionError(f"--token-file: {error}") from error


def certificate_of(options: ServeOptions) -> Certificate | None:
    """None: no TLS. Raises OptionError, RunError."""
    if (options.tls_cert is None) != (options.tls_key is None):
        raise OptionError(
            "--tls-cert and --tls-key go together: give both, or --tls alone for a certificate of its own"
        )
    try:
        if options.tls_cert is not None and options.tls_key is not None:
            return given_certificate(options.tls_cert, options.tls_key)
        return own_certificate() if options.tls else None
    except CertificateError as error:
        raise RunError(str(error)) from error


def limits_of(options: ServeOptions) -> Limits:
    """Raises OptionError."""
    limits = DEFAULT_LIMITS
    if options.volume_memory is not None:
        if not LEAST_VOLUME_MIB <= options.volume_memory <= MOST_VOLUME_MIB:
            raise OptionError(
                f"--volume-memory {options.volume_memory}: expected MiB, {LEAST_VOLUME_MIB} to {MOST_VOLUME_MIB}"
            )
        limits = replace(limits, volume_bytes=options.volume_memory * MIB)
    limits = replace(limits, room_retention=_retention_limits(options))
    sessions = limits.sessions if options.sessions is None else options.sessions
    per_address = min(sessions, limits.sessions_per_address)
    if options.sessions_per_address is not None:
        per_address = options.sessions_per_address
    return replace(limits, sessions=sessions, sessions_per_address=per_address)


def _retention_limits(options: ServeOptions) -> RetentionLimits:
    """0: no limit."""
    retention = DEFAULT_LIMITS.room_retention
    if options.data_gib is not None:
        retention = replace(retention, space_bytes=int(options.data_gib * GIB) or None)
    if options.data_days is not None:
        retention = replace(retention, age_s=options.data_days * DAY_S or None)
    return retention


def data_folder(text: str | None) -> Path | None:
    """Folder of saved rooms; None: rooms are not saved. Raises RunError if it cannot be written."""
    if text == NO_DATA:
        return None
    folder = user_data_path("probeless") / "rooms" if text is None else Path(text)
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            pass
    except OSError as error:
        raise RunError(
            f"rooms cannot be kept in {folder} ({error.strerror}): name another folder with --data, or --data none"
        ) from error
    return folder


def objects_folder(path: Path | None) -> Path | None:
    """Folder of models that clients may place. Raises OptionError if it does not exist."""
    if path is not None and not path.is_dir():
        raise OptionError(f"--objects {path}: no such folder; give one with .glb, .obj, .ply or .stl files in it")
    return path


def log_format_of(text: str) -> LogFormat:
    """Raises OptionError."""
    if text not in get_args(LogFormat):
        raise OptionError(f"--log {text}: expected text or json")
    return cast(LogFormat, text)


def exit_soon(status: int) -> None:
    """End this process soon with `status`, even if a thread waits for a device that never answers."""

    def stop() -> None:
        log.error("a session is stuck on the device and was given up")
        os._exit(status)

    timer = threading.Timer(EXIT_TIMEOUT_S, stop)
    timer.daemon = True
    timer.start()


def _origin(text: str) -> str:
    """An origin in the form of a browser's header. Raises OptionError."""
    parts = urlsplit(text.lower().rstrip("/"))
    if parts.scheme not in ("http", "https") or not parts.netloc or parts.path or parts.query:
        raise OptionError(f"--allow-origin {text}: expected https://HOST or https://HOST:PORT, as a browser shows it")
    return f"{parts.scheme}://{parts.netloc}"


def _proxies(texts: tuple[str, ...]) -> TrustedProxies:
    """Raises OptionError."""
    try:
        return TrustedProxies(texts)
    except ValueError as error:
        raise OptionError(
            f"--trusted-proxy: {error}; expected ADDRESS or ADDRESS/BITS, such as 10.0.0.5 or 10.0.0.0/24"
        ) from error
