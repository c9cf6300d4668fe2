"""The door over a real socket: tokens, pages of elsewhere, and how programs of the same user get in by themselves."""

import asyncio
import os
import stat
from pathlib import Path

import httpx
import pytest

from client.streaming.client import Access
from protocol.local_keys import LocalKey, find_key, key_left, key_path
from protocol.messages import Error
from server.service.app import create_app
from server.service.edge.authenticator import Authenticator, is_loopback, is_token, new_token
from server.service.serve import BackgroundServer
from server.service.service import Service
from tests.service.admission import TOKEN, connected, not_connected
from tests.service.fakes import FAKE_DEVICE, fake_mesh
from tests.service.wire import Wire


@pytest.fixture
def locked(start_server) -> BackgroundServer:
    """A server that asks for TOKEN."""
    return start_server(authenticator=Authenticator(TOKEN))


def refused(url: str, path: str = "/v1/stream", **options: str) -> tuple[int, str]:
    """How a connection ends that is not let in: code and line."""
    wire = Wire(url, path=path, **options)
    code, reason, messages = wire.ending()
    assert messages == [Error(reason=reason, fatal=True)], "the close frame must hold the whole line"
    return code, reason


def test_without_its_token_nobody_comes_in_and_is_told_what_to_do(locked) -> None:
    code, reason = refused(locked.url)
    assert code == 4401
    assert reason == "the token is missing: use the URL that the server printed at its start, which ends in ?token=..."


@pytest.mark.parametrize("given", ["", "a", "a+b/c=d&e?f", TOKEN + "x", TOKEN.upper(), "\u00e4"])
def test_wrong_tokens_are_refused_wherever_they_stand(locked, given) -> None:
    query = str(httpx.QueryParams(token=given))
    assert refused(locked.url, f"/v1/stream?{query}")[0] == 4401
    assert "is wrong" in refused(locked.url, f"/v1/stream?{query}")[1]
    if given.isascii():
        assert refused(locked.url, Authorization=f"Bearer {given}")[0] == 4401
    assert refused(locked.url, Authorization=f"Basic {TOKEN}")[0] == 4401


def test_the_token_lets_in_as_header_and_in_the_url(locked) -> None:
    for wire in (
        Wire(locked.url, Authorization=f"Bearer {TOKEN}"),
        Wire(locked.url, path=f"/v1/stream?{httpx.QueryParams(token=TOKEN)}"),
    ):
        assert wire.greet().session
        wire.hang_up()


def test_the_laptop_client_takes_url_option_and_what_is_left_for_it(locked, monkeypatch) -> None:
    assert connected(locked.way_in) == "a fake device"
    assert connected(locked.url, Access(token=TOKEN)) == "a fake device"
    assert connected(locked.url) == "a fake device"  # the key file
    assert connected(locked.url.replace("127.0.0.1", "localhost")) == "a fake device"
    assert "token is wrong" in not_connected(f"{locked.url}/?token=x")
    assert "token is wrong" in not_connected(locked.way_in, Access(token="x"))
    monkeypatch.setenv("PROBELESS_KEYS", "/nowhere")
    assert "token is missing: use the URL" in not_connected(locked.url)


def test_the_key_is_for_the_user_alone_and_goes_with_the_server(start_server) -> None:
    server = start_server(authenticator=Authenticator(TOKEN))
    path = key_path(int(server.url.rpartition(":")[2]))
    assert stat.S_IMODE(path.stat().st_mode) == 0o600
    assert stat.S_IMODE(path.parent.stat().st_mode) == 0o700
    server.stop()
    assert list(path.parent.iterdir()) == []


def test_keys_that_cannot_be_trusted_are_not_used() -> None:
    with key_left(1, LocalKey(token="x", pid=os.getpid())):
        assert find_key(1).token == "x"
        key_path(1).chmod(0o644)
        assert find_key(1) is None
    for content in (b"", b"{}", b'{"token": 7, "pid": 1}'):
        key_path(2).write_bytes(content)
        key_path(2).chmod(0o600)
        assert find_key(2) is None
    with key_left(3, LocalKey(token="x", pid=2**22 + 1)):  # above what Linux gives
        assert find_key(3) is None
    assert find_key(4) is None


def test_a_later_servers_key_is_left_alone() -> None:
    with key_left(1, LocalKey(token="earlier", pid=os.getpid())):
        later = key_left(1, LocalKey(token="later", pid=os.getpid()))
        later.__enter__()
    assert find_key(1).token == "later"
    later.__exit__(None, None, None)
    assert find_key(1) is None


def test_a_key_that_cannot_be_left_stops_nobody(start_server, tmp_path: Path, monkeypatch, caplog) -> None:
    (tmp_path / "file").touch()
    monkeypatch.setenv("PROBELESS_KEYS", str(tmp_path / "file" / "keys"))
    server = start_server(authenticator=Authenticator(TOKEN))
    assert connected(server.way_in) == "a fake device"
    assert "must be given the token" in caplog.text


def test_pages_of_elsewhere_are_refused_even_with_the_token(locked) -> None:
    bearer = {"Authorization": f"Bearer {TOKEN}"}
    for origin in ("https://evil.example", "null", "http://127.0.0.1:1", "http://127.0.0.1", ""):
        code, reason = refused(locked.url, Origin=origin, **bearer)
        assert code == 4403
        assert "--allow-origin" in reason
    wire = Wire(locked.url, Origin=locked.url, **bearer)
    assert wire.greet().session
    wire.hang_up()
    assert refused(locked.url, Origin=locked.url)[0] == 4401


def test_an_allowed_origin_may_come_from_elsewhere(start_server) -> None:
    server = start_server(authenticator=Authenticator(TOKEN, frozenset({"https://app.example"})))
    bearer = {"Authorization": f"Bearer {TOKEN}"}
    wire = Wire(server.url, Origin="https://app.example", **bearer)
    assert wire.greet().session
    wire.hang_up()
    assert refused(server.url, Origin="http://app.example", **bearer)[0] == 4403


def test_without_a_token_a_name_that_was_pointed_here_is_no_own_address(server) -> None:
    port = server.url.rpartition(":")[2]
    evil = f"http://evil.example:{port}"
    assert refused(server.url, Origin=evil, called=evil)[0] == 4403
    for own in (server.url, f"http://localhost:{port}"):
        wire = Wire(server.url, Origin=own, called=own)
        assert wire.greet().session
        wire.hang_up()


def get(path: str, authenticator: Authenticator, client: str, lab, **headers: str) -> httpx.Response:
    """A request of `client`, an address, to the app itself."""
    service = Service(FAKE_DEVICE, pipeline_factory=lab.build, mesh_loader=fake_mesh)

    async def ask() -> httpx.Response:
        transport = httpx.ASGITransport(create_app(service, authenticator=authenticator), client=(client, 1))
        async with httpx.AsyncClient(transport=transport, base_url="http://test") as http:
            return await http.get(path, headers=headers)

    return asyncio.run(ask())


def test_metrics_are_for_this_machine_and_whoever_has_the_token(lab) -> None:
    authenticator = Authenticator(TOKEN)
    strange = get("/metrics", authenticator, "192.0.2.7", lab)
    assert strange.status_code == 401
    assert strange.text.count("\n") == 1
    assert "?token=" in strange.text
    assert get("/metrics", authenticator, "192.0.2.7", lab, Authorization=f"Bearer {TOKEN}").status_code == 200
    assert get(f"/metrics?{httpx.QueryParams(token=TOKEN)}", authenticator, "192.0.2.7", lab).status_code == 200
    assert get("/metrics", authenticator, "127.0.0.1", lab).status_code == 200
    assert get("/metrics", Authenticator(), "192.0.2.7", lab).status_code == 200


def test_health_is_open_and_says_no_secret(locked) -> None:
    answer = httpx.get(f"{locked.url}/healthz", trust_env=False)
    assert answer.status_code == 200
    assert TOKEN not in answer.text


@pytest.mark.parametrize(("host", "own"), [("127.9.9.9", True), ("::1", True), ("LOCALHOST", True), ("0.0.0.0", False)])
def test_loopback(host, own) -> None:
    assert is_loopback(host) is own
    assert not is_loopback("::ffff:192.0.2.1")
    assert is_loopback("::ffff:127.0.0.1")


def test_tokens_are_long_and_never_the_same() -> None:
    tokens = {new_token() for _ in range(50)}
    assert len(tokens) == 50
    assert min(map(len, tokens)) >= 32
    assert all(map(is_token, tokens))
    assert not any(map(is_token, ("", "a b", "a\n", "ä", "x" * 257)))
