"""TLS certificates: a given one, or one that this user's own authority signs, created once and stored."""

from __future__ import annotations

import contextlib
import hashlib
import socket
import ssl
from dataclasses import dataclass, replace
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import TYPE_CHECKING

from platformdirs import user_data_path

if TYPE_CHECKING:
    from cryptography import x509

LIFETIME = timedelta(days=800)
"""iOS rejects certificates with a lifetime above 825 days."""
RENEWED_BEFORE = timedelta(days=7)
NOWHERE = ("192.0.2.1", 9)
"""Documentation address (RFC 5737), used to find the outgoing interface; nothing is sent."""


class CertificateError(Exception):
    """The certificate cannot be used; one line."""


@dataclass(frozen=True)
class Certificate:
    """PEM files, and the SHA-256 fingerprint of the certificate in the form AB:CD:..."""

    certificate: Path
    key: Path
    fingerprint: str
    authority: Path | None = None
    """Certificate of the own authority that signed it; None: another did."""


def given_certificate(certificate: Path, key: Path) -> Certificate:
    """Load and check a certificate (with its chain) and its key. Raises CertificateError."""
    try:
        ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER).load_cert_chain(certificate, key, password=lambda: "")
        return Certificate(certificate, key, fingerprint_of(certificate))
    except (OSError, ValueError) as error:  # ssl.SSLError is an OSError
        why = getattr(error, "reason", None) or getattr(error, "strerror", None) or str(error)
        raise CertificateError(
            f"{certificate} and {key} cannot be used ({why}): give a certificate and its key without a password, as PEM"
        ) from error


def own_certificate(folder: Path | None = None) -> Certificate:
    """The stored certificate for all names and addresses of this machine. Raises CertificateError.

    A new one if there is none, it expires soon, or the machine has another name or address.
    """
    from server.service.edge.own_authority import kept_authority, signed, write_privately  # only with TLS

    folder = folder or user_data_path("probeless") / "tls"
    certificate, key, authority = (folder / f"{name}.pem" for name in ("certificate", "key", "authority"))
    names, addresses = host_names(), local_addresses()
    try:
        signer = kept_authority(authority, folder / "authority_key.pem", names, addresses)
        if not (key.is_file() and _serves(certificate, {*names, *addresses}, signer.certificate)):
            chain, secret = signed(signer, names, addresses, LIFETIME)
            write_privately(key, secret)
            write_privately(certificate, chain)
    except OSError as error:
        raise CertificateError(f"no certificate can be kept in {folder} ({error.strerror}): give --tls-cert") from error
    return replace(given_certificate(certificate, key), authority=authority)


def fingerprint_of(certificate: Path) -> str:
    """SHA-256 of the first certificate in a PEM file. Raises OSError, ValueError."""
    pem = certificate.read_text(encoding="ascii")
    first = pem[pem.index(ssl.PEM_HEADER) : pem.index(ssl.PEM_FOOTER) + len(ssl.PEM_FOOTER)]
    return hashlib.sha256(ssl.PEM_cert_to_DER_cert(first)).digest().hex(":").upper()


def _serves(certificate: Path, needed: set[str], authority: x509.Certificate) -> bool:
    """Whether a stored certificate is of this authority, for all that is needed, and not about to expire."""
    from cryptography import x509
    from cryptography.exceptions import InvalidSignature

    from server.service.edge.own_authority import names_of

    try:
        found = x509.load_pem_x509_certificate(certificate.read_bytes())
        found.verify_directly_issued_by(authority)
        is_complete = needed <= names_of(found)
    except (FileNotFoundError, ValueError, TypeError, InvalidSignature, x509.ExtensionNotFound):
        return False
    return is_complete and found.not_valid_after_utc - RENEWED_BEFORE > datetime.now(UTC)


def host_names() -> list[str]:
    """Names of this machine, as others may use them."""
    own = socket.gethostname().lower()
    found = ["localhost", own, f"{own.partition('.')[0]}.local", socket.getfqdn().lower()]
    return [name for name in dict.fromkeys(found) if name.isascii() and len(name) <= 253 and _is_name(name)]


def local_addresses() -> list[str]:
    """IPv4 and IPv6 addresses of this machine, without zones."""
    found = {"127.0.0.1", "::1"}
    with contextlib.suppress(OSError):
        found |= {str(entry[4][0]).partition("%")[0] for entry in socket.getaddrinfo(socket.gethostname(), None)}
    with contextlib.suppress(OSError), socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as outward:
        outward.connect(NOWHERE)  # finds the interface that leads out
        found.add(outward.getsockname()[0])
    return sorted(found)


def reachable_host() -> str:
    """Address by which other machines of the network most likely reach this one; its name where it has none."""
    with contextlib.suppress(OSError), socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as outward:
        outward.connect(NOWHERE)
        return str(outward.getsockname()[0])
    others = [address for address in local_addresses() if address not in ("127.0.0.1", "127.0.1.1", "::1")]
    return others[0] if others else socket.gethostname()


def _is_name(name: str) -> bool:
    return all(part and set(part) <= set("abcdefghijklmnopqrstuvwxyz0123456789-_") for part in name.split("."))
