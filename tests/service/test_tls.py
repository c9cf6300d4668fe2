"""TLS over a real socket: the certificate that the server makes, and clients that check it before they say anything."""

import contextlib
import shutil
import socket
import ssl
import stat
import subprocess
import threading
from datetime import timedelta
from pathlib import Path

import httpx
import pytest
from cryptography import x509

from client.streaming.access import AccessError, connection_parameters, fingerprint_bytes
from client.streaming.client import Access
from server.service.edge import tls
from server.service.edge.authenticator import Authenticator
from server.service.edge.own_authority import kept_authority, names_of, signed
from server.service.edge.tls import Certificate, CertificateError, given_certificate, own_certificate
from server.service.serve import BackgroundServer
from tests.service.admission import TOKEN, connected, not_connected


@pytest.fixture(scope="module")
def certificate(tmp_path_factory: pytest.TempPathFactory) -> Certificate:
    return own_certificate(tmp_path_factory.mktemp("tls"))


@pytest.fixture
def secure(start_server, certificate: Certificate) -> BackgroundServer:
    return start_server(authenticator=Authenticator(TOKEN), certificate=certificate)


def test_the_certificate_is_made_once_for_the_user_alone(tmp_path: Path) -> None:
    first = own_certificate(tmp_path / "tls")
    assert stat.S_IMODE(first.key.stat().st_mode) == 0o600
    assert own_certificate(tmp_path / "tls") == first


def test_the_certificate_names_this_machine(certificate: Certificate) -> None:
    found = x509.load_pem_x509_certificate(certificate.certificate.read_bytes())
    names = found.extensions.get_extension_for_class(x509.SubjectAlternativeName).value
    assert {"localhost", socket.gethostname().lower()} <= set(names.get_values_for_type(x509.DNSName))
    assert {"127.0.0.1", "::1"} <= {str(address) for address in names.get_values_for_type(x509.IPAddress)}
    assert found.not_valid_after_utc - found.not_valid_before_utc < timedelta(days=825)  # the most that phones take


def test_a_certificate_whose_time_is_nearly_over_is_made_again(tmp_path: Path, monkeypatch) -> None:
    first = own_certificate(tmp_path)
    monkeypatch.setattr(tls, "RENEWED_BEFORE", tls.LIFETIME + timedelta(days=1))
    assert own_certificate(tmp_path).fingerprint != first.fingerprint


def test_a_machine_with_another_address_gets_a_certificate_of_the_same_authority(tmp_path: Path, monkeypatch) -> None:
    first = own_certificate(tmp_path)
    assert first.authority is not None
    trusted = first.authority.read_bytes()
    monkeypatch.setattr(tls, "local_addresses", lambda: ["127.0.0.1", "192.168.77.5", "::1"])
    second = own_certificate(tmp_path)
    found = x509.load_pem_x509_certificate(second.certificate.read_bytes())
    assert second.fingerprint != first.fingerprint
    assert "192.168.77.5" in names_of(found)
    assert second.authority.read_bytes() == trusted
    found.verify_directly_issued_by(x509.load_pem_x509_certificate(trusted))
    assert own_certificate(tmp_path) == second
    monkeypatch.setattr(tls, "local_addresses", lambda: ["127.0.0.1", "203.0.113.9"])  # a public one
    assert own_certificate(tmp_path).authority.read_bytes() != trusted


def test_a_self_signed_certificate_of_earlier_versions_is_replaced(tmp_path: Path) -> None:
    other = own_certificate(tmp_path / "other")
    for name, source in (("certificate.pem", other.certificate), ("key.pem", other.key)):
        (tmp_path / name).write_bytes(source.read_bytes())
    assert own_certificate(tmp_path).fingerprint != other.fingerprint


def openssl_verify(authority: Path, certificate: Path, *options: str) -> subprocess.CompletedProcess:
    command = ["openssl", "verify", "-x509_strict", *options, "-CAfile", authority, certificate]
    return subprocess.run(command, capture_output=True, text=True, check=False)


def test_openssl_trusts_the_server_by_its_authority_for_local_names_alone(
    certificate: Certificate, tmp_path: Path
) -> None:
    if shutil.which("openssl") is None:
        pytest.skip("there is no openssl: apt-get install openssl")
    done = openssl_verify(certificate.authority, certificate.certificate, "-verify_ip", "127.0.0.1")
    assert done.returncode == 0, done.stderr
    folder = certificate.authority.parent
    signer = kept_authority(certificate.authority, folder / "authority_key.pem", ["localhost"], ["127.0.0.1"])
    for name, addresses in (("bank.example", []), ("localhost", ["203.0.113.9"])):
        forged = tmp_path / "forged.pem"
        forged.write_bytes(signed(signer, [name], addresses, timedelta(days=1))[0])
        assert "permitted subtree violation" in openssl_verify(certificate.authority, forged).stderr


def test_a_device_gets_the_authority_without_a_token_and_trusts_the_server_by_it(secure, tmp_path: Path) -> None:
    unchecked = httpx.get(f"{secure.url}/ca.crt", verify=False, trust_env=False)
    assert unchecked.headers["content-type"] == "application/x-x509-ca-cert"
    (tmp_path / "ca.crt").write_bytes(unchecked.content)
    context = ssl.create_default_context(cafile=tmp_path / "ca.crt")
    assert httpx.get(f"{secure.url}/healthz", verify=context, trust_env=False).status_code == 200
    assert connected(secure.way_in, Access(tls_ca=tmp_path / "ca.crt")) == "a fake device"


def test_a_server_with_a_given_certificate_offers_no_authority(start_server, certificate: Certificate) -> None:
    server = start_server(certificate=given_certificate(certificate.certificate, certificate.key))
    context = ssl.create_default_context(cafile=certificate.certificate)
    assert httpx.get(f"{server.url}/ca.crt", verify=context, trust_env=False).status_code == 404


def test_the_fingerprint_is_what_openssl_says(certificate: Certificate) -> None:
    if shutil.which("openssl") is None:
        pytest.skip("there is no openssl: apt-get install openssl")
    command = ["openssl", "x509", "-noout", "-fingerprint", "-sha256", "-in", certificate.certificate]
    said = subprocess.run(command, capture_output=True, text=True, check=True).stdout
    assert said.strip().endswith(certificate.fingerprint)


def test_page_and_socket_are_served_over_tls(secure, certificate: Certificate) -> None:
    assert secure.url.startswith("https://")
    context = ssl.create_default_context(cafile=certificate.certificate)
    assert httpx.get(f"{secure.url}/healthz", verify=context, trust_env=False).status_code == 200
    assert connected(secure.way_in, Access(tls_ca=certificate.certificate)) == "a fake device"
    assert connected(secure.way_in, Access(tls_fingerprint=certificate.fingerprint)) == "a fake device"
    plain = certificate.fingerprint.replace(":", "").lower()
    assert connected(secure.way_in.replace("https", "wss"), Access(tls_fingerprint=plain)) == "a fake device"
    assert connected(secure.url) == "a fake device"  # by what the server left for its user


def test_a_certificate_of_somebody_else_is_one_line(secure, tmp_path: Path, monkeypatch) -> None:
    other = own_certificate(tmp_path / "other")
    line = not_connected(secure.way_in, Access(tls_fingerprint=other.fingerprint))
    assert "is not the one of --tls-fingerprint" in line
    line = not_connected(secure.way_in, Access(tls_ca=other.certificate))
    assert "is not trusted" in line
    assert "--tls-fingerprint, which the server prints" in line
    monkeypatch.setenv("PROBELESS_KEYS", "/nowhere")
    assert "is not trusted" in not_connected(secure.way_in)


def test_nothing_is_said_to_a_server_with_the_wrong_certificate(certificate: Certificate, tmp_path: Path) -> None:
    other = own_certificate(tmp_path / "other")
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    context.load_cert_chain(other.certificate, other.key)
    heard: list[bytes] = []

    def listen(listener: socket.socket) -> None:
        tcp, _ = listener.accept()
        with tcp, contextlib.suppress(OSError), context.wrap_socket(tcp, server_side=True) as secured:
            heard.append(secured.recv(1000))

    with socket.create_server(("127.0.0.1", 0)) as listener:
        thread = threading.Thread(target=listen, args=(listener,))
        thread.start()
        url = f"https://127.0.0.1:{listener.getsockname()[1]}/?token={TOKEN}"
        assert "another server answers there" in not_connected(url, Access(tls_fingerprint=certificate.fingerprint))
        thread.join()
    assert b"".join(heard) == b""


def test_tls_against_none_and_none_against_tls_are_told_apart(secure, server, certificate: Certificate) -> None:
    pinned = Access(tls_fingerprint=certificate.fingerprint)
    assert "does not speak TLS" in not_connected(server.url.replace("http", "https"), pinned)
    assert "https://" in not_connected(secure.url.replace("https", "http"))
    assert "give https://" in not_connected(server.url, pinned)


@pytest.mark.parametrize("text", ["", "12", "zz" * 32, "a" * 63, "sha256:"])
def test_a_fingerprint_that_is_none_is_told(text) -> None:
    with pytest.raises(AccessError, match="expected SHA-256"):
        fingerprint_bytes(text)


def test_trust_that_cannot_be_read_is_told(tmp_path: Path) -> None:
    (tmp_path / "no.pem").write_text("nothing")
    for path in (tmp_path / "no.pem", tmp_path / "absent.pem"):
        with pytest.raises(AccessError, match=path.name):
            connection_parameters("https://host", Access(tls_ca=path))
    with pytest.raises(AccessError, match="leave one of the two out"):
        connection_parameters("https://host", Access(tls_ca=path, tls_fingerprint="ab" * 32))


def test_certificates_that_cannot_be_used_are_one_line(certificate: Certificate, tmp_path: Path) -> None:
    other = own_certificate(tmp_path / "other")
    (tmp_path / "no.pem").write_text("nothing")
    for pair in (
        (tmp_path / "absent.pem", certificate.key),
        (tmp_path / "no.pem", certificate.key),
        (certificate.certificate, other.key),
    ):
        with pytest.raises(CertificateError) as error:
            given_certificate(*pair)
        assert "\n" not in str(error.value)
        assert str(pair[0]) in str(error.value)
    (tmp_path / "file").touch()
    with pytest.raises(CertificateError, match="give --tls-cert"):
        own_certificate(tmp_path / "file" / "tls")
