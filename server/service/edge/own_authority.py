"""A certificate authority of this user's own, which signs the server's certificates: a phone that trusts it once trusts
every later certificate too, also after the machine's address has changed.

It may sign for names and addresses of local networks alone (name constraints, RFC 5280 4.2.1.10): whoever trusts it
trusts it with nothing else.
"""

from __future__ import annotations

import ipaddress
import os
import socket
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from pathlib import Path

from cryptography import x509
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.x509.oid import ExtendedKeyUsageOID, NameOID

AUTHORITY_LIFETIME = timedelta(days=3650)
LOCAL_NETWORKS = (
    "10.0.0.0/8",
    "172.16.0.0/12",
    "192.168.0.0/16",
    "100.64.0.0/10",
    "169.254.0.0/16",
    "127.0.0.0/8",
    "::1/128",
    "fc00::/7",
    "fe80::/10",
)
"""Private, shared, link-local and loopback addresses."""
LOCAL_DOMAINS = ("localhost", "local", "lan", "home.arpa", "internal")
PEM = serialization.Encoding.PEM

_Network = ipaddress.IPv4Network | ipaddress.IPv6Network
_Key = ec.EllipticCurvePrivateKey


@dataclass(frozen=True)
class Authority:
    """Certificate and private key."""

    certificate: x509.Certificate
    key: _Key


def kept_authority(certificate: Path, key: Path, names: Sequence[str], addresses: Sequence[str]) -> Authority:
    """The stored authority; a new one if there is none, it ends soon, or it may not sign for these. Raises OSError."""
    found = _read(certificate, key)
    if found is not None and _permits(found.certificate, names, addresses):
        return found
    made = _make(names, addresses)
    write_privately(key, _secret(made.key))
    write_privately(certificate, made.certificate.public_bytes(PEM))
    return made


def signed(
    authority: Authority, names: Sequence[str], addresses: Sequence[str], lifetime: timedelta
) -> tuple[bytes, bytes]:
    """PEM of a new server certificate with its authority's behind it, and of its private key."""
    private = ec.generate_private_key(ec.SECP256R1())
    alternatives: list[x509.GeneralName] = [x509.DNSName(name) for name in names]
    alternatives += [x509.IPAddress(ipaddress.ip_address(address)) for address in addresses]
    built = (
        _builder(f"probeless on {socket.gethostname()}", authority.certificate.subject, private, lifetime)
        .add_extension(x509.SubjectAlternativeName(alternatives), critical=False)
        .add_extension(x509.BasicConstraints(ca=False, path_length=None), critical=True)
        .add_extension(_usage("digital_signature"), critical=True)
        .add_extension(x509.ExtendedKeyUsage([ExtendedKeyUsageOID.SERVER_AUTH]), critical=False)
        .add_extension(x509.AuthorityKeyIdentifier.from_issuer_public_key(authority.key.public_key()), critical=False)
        .sign(authority.key, hashes.SHA256())
    )
    return built.public_bytes(PEM) + authority.certificate.public_bytes(PEM), _secret(private)


def names_of(certificate: x509.Certificate) -> set[str]:
    """DNS names and addresses that a server's certificate is for."""
    found = certificate.extensions.get_extension_for_class(x509.SubjectAlternativeName).value
    return {*found.get_values_for_type(x509.DNSName), *map(str, found.get_values_for_type(x509.IPAddress))}


def write_privately(path: Path, data: bytes) -> None:
    """Write a file atomically, readable by this user only. Raises OSError."""
    path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
    beside = path.with_suffix(f".{os.getpid()}")
    beside.unlink(missing_ok=True)
    with open(os.open(beside, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600), "wb") as file:
        file.write(data)
    beside.replace(path)


def _make(names: Sequence[str], addresses: Sequence[str]) -> Authority:
    private = ec.generate_private_key(ec.SECP256R1())
    subject = f"probeless authority of {socket.gethostname()}"
    permitted: list[x509.GeneralName] = [x509.DNSName(name) for name in dict.fromkeys((*LOCAL_DOMAINS, *names))]
    permitted += [x509.IPAddress(network) for network in _networks(addresses)]
    built = (
        _builder(subject, _name(subject), private, AUTHORITY_LIFETIME)
        .add_extension(x509.BasicConstraints(ca=True, path_length=0), critical=True)
        .add_extension(x509.NameConstraints(permitted, None), critical=True)
        .add_extension(_usage("key_cert_sign", "crl_sign"), critical=True)
        .sign(private, hashes.SHA256())
    )
    return Authority(built, private)


def _builder(subject: str, issuer: x509.Name, private: _Key, lifetime: timedelta) -> x509.CertificateBuilder:
    now = datetime.now(UTC)
    return x509.CertificateBuilder(
        issuer,
        _name(subject),
        private.public_key(),
        x509.random_serial_number(),
        now - timedelta(hours=1),
        now + lifetime,
    ).add_extension(x509.SubjectKeyIdentifier.from_public_key(private.public_key()), critical=False)


def _name(text: str) -> x509.Name:
    return x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, text[:64])])


def _usage(*uses: str) -> x509.KeyUsage:
    every = (
        "digital_signature",
        "content_commitment",
        "key_encipherment",
        "data_encipherment",
        "key_agreement",
        "key_cert_sign",
        "crl_sign",
        "encipher_only",
        "decipher_only",
    )
    return x509.KeyUsage(**{name: name in uses for name in every})


def _networks(addresses: Iterable[str]) -> list[_Network]:
    """The local networks, and each address that is in none of them."""
    networks = [ipaddress.ip_network(text) for text in LOCAL_NETWORKS]
    own = [ipaddress.ip_address(text) for text in addresses]
    return [
        *networks,
        *(ipaddress.ip_network(each) for each in own if not any(each in network for network in networks)),
    ]


def _permits(certificate: x509.Certificate, names: Sequence[str], addresses: Sequence[str]) -> bool:
    """Whether the authority is valid for a year to come, and may sign for all of these."""
    if certificate.not_valid_after_utc - timedelta(days=365) < datetime.now(UTC):
        return False
    try:
        found = certificate.extensions.get_extension_for_class(x509.NameConstraints).value.permitted_subtrees or []
    except x509.ExtensionNotFound:
        return False
    domains = [each.value for each in found if isinstance(each, x509.DNSName)]
    values = [each.value for each in found if isinstance(each, x509.IPAddress)]
    networks = [value for value in values if isinstance(value, ipaddress.IPv4Network | ipaddress.IPv6Network)]
    return all(any(f".{name}".endswith(f".{domain}") for domain in domains) for name in names) and all(
        any(ipaddress.ip_address(address) in network for network in networks) for address in addresses
    )


def _read(certificate: Path, key: Path) -> Authority | None:
    try:
        private = serialization.load_pem_private_key(key.read_bytes(), None)
        found = x509.load_pem_x509_certificate(certificate.read_bytes())
    except (FileNotFoundError, ValueError, TypeError):
        return None
    return Authority(found, private) if isinstance(private, ec.EllipticCurvePrivateKey) else None


def _secret(private: _Key) -> bytes:
    return private.private_bytes(PEM, serialization.PrivateFormat.PKCS8, serialization.NoEncryption())
