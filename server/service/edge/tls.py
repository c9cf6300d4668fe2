"""TLS certificates: a given one, or a self-signed one that is created once and stored."""

from __future__ import annotations

import contextlib
import hashlib
import ipaddress
import os
import socket
import ssl
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from pathlib import Path

from platformdirs import user_data_path

LIFETIME = timedelta(days=800)
"""iOS rejects certificates with a longer lifetime."""
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
    """The stored self-signed certificate; a new one if there is none or it expires soon. Raises CertificateError."""
    folder = folder or user_data_path("probeless") / "tls"
    certificate, key = folder / "certificate.pem", folder / "key.pem"
    try:
        if not (key.is_file() and _lasts(certificate)):
            _make(certificate, key)
    except OSError as error:
        raise CertificateError(f"no certificate can be kept in {folder} ({error.strerror}): give --tls-cert") from error
    return given_certificate(certificate, key)


def fingerprint_of(certificate: Path) -> str:
    """SHA-256 of the first certificate in a PEM file. Raises OSError, ValueError."""
    pem = certificate.read_text(encoding="ascii")
    first = pem[pem.index(ssl.PEM_HEADER) : pem.index(ssl.PEM_FOOTER) + len(ssl.PEM_FOOTER)]
    return hashlib.sha256(ssl.PEM_cert_to_DER_cert(first)).digest().hex(":").upper()


def _lasts(certificate: Path) -> bool:
    from cryptography import x509

    try:
        found = x509.load_pem_x509_certificate(certificate.read_bytes())
    except (FileNotFoundError, ValueError):
        return False
    return found.not_valid_after_utc - RENEWED_BEFORE > datetime.now(UTC)


def _make(certificate: Path, key: Path) -> None:
    """Write a key and a self-signed certificate for all names and addresses of this machine."""
    from cryptography import x509
    from cryptography.hazmat.primitives import hashes, serialization
    from cryptography.hazmat.primitives.asymmetric import ec
    from cryptography.x509.oid import ExtendedKeyUsageOID, NameOID

    private = ec.generate_private_key(ec.SECP256R1())
    name = x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, f"probeless on {socket.gethostname()}"[:64])])
    names: list[x509.GeneralName] = [x509.DNSName(host) for host in host_names()]
    names += [x509.IPAddress(ipaddress.ip_address(address)) for address in local_addresses()]
    uses = dict.fromkeys(
        ("content_commitment", "key_encipherment", "data_encipherment", "key_agreement", "crl_sign"), False
    )
    built = (
        x509.CertificateBuilder(name, name, private.public_key(), x509.random_serial_number())
        .not_valid_before(datetime.now(UTC) - timedelta(hours=1))
        .not_valid_after(datetime.now(UTC) + LIFETIME)
        .add_extension(x509.SubjectAlternativeName(names), critical=False)
        .add_extension(x509.BasicConstraints(ca=True, path_length=0), critical=True)  # a phone can be told to trust it
        .add_extension(
            x509.KeyUsage(digital_signature=True, key_cert_sign=True, encipher_only=False, decipher_only=False, **uses),
            critical=True,
        )
        .add_extension(x509.ExtendedKeyUsage([ExtendedKeyUsageOID.SERVER_AUTH]), critical=False)
        .add_extension(x509.SubjectKeyIdentifier.from_public_key(private.public_key()), critical=False)
        .sign(private, hashes.SHA256())
    )
    pem = serialization.Encoding.PEM
    secret = private.private_bytes(pem, serialization.PrivateFormat.PKCS8, serialization.NoEncryption())
    key.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
    _write_privately(key, secret)
    _write_privately(certificate, built.public_bytes(pem))


def _write_privately(path: Path, data: bytes) -> None:
    """Write a file atomically, readable by this user only."""
    beside = path.with_suffix(f".{os.getpid()}")
    beside.unlink(missing_ok=True)
    with open(os.open(beside, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600), "wb") as file:
        file.write(data)
    beside.replace(path)


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


def _is_name(name: str) -> bool:
    return all(part and set(part) <= set("abcdefghijklmnopqrstuvwxyz0123456789-_") for part in name.split("."))
