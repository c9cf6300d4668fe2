"""What the Python client tells a person whose server is full, leaving, started anew, another's, or does not want it."""

from __future__ import annotations

import asyncio
from types import SimpleNamespace

import pytest

from client.streaming.client import Access, ClientError, RoomPlace, StreamClient
from protocol.messages import Hello
from server.service.edge.authenticator import Authenticator
from server.service.graceful_shutdown import DRAINING, GOODBYE
from tests.service.draining import draining
from tests.service.fakes import CAMERA, PATIENCE_S
from tests.service.wire import Wire


def told(url: str, **options: object) -> str:
    """The line of a client that says hello, without the address in front."""

    async def hello() -> None:
        client = await StreamClient.connect(url, access=options.pop("access", None))
        try:
            await client.hello(CAMERA, **options)
        finally:
            await client.close()

    with pytest.raises(ClientError) as error:
        asyncio.run(asyncio.wait_for(hello(), PATIENCE_S))
    line = str(error.value)
    assert "\n" not in line
    start = f"the server at {url.partition('?')[0].removesuffix('/')} closed the connection: "
    assert line.startswith(start)
    return line.removeprefix(start)


def test_a_full_server(start_server) -> None:
    server = start_server(max_sessions=1)
    wire = Wire(server.url)
    wire.greet()
    assert told(server.url) == "all 1 sessions of this server are taken: try again later"
    wire.hang_up()


def test_a_server_of_another_version(start_server, monkeypatch) -> None:
    monkeypatch.setattr("server.service.edge.connection.SUBPROTOCOL", "probeless-v9")
    assert told(start_server().url) == (
        "this server speaks probeless-v9, you asked for probeless-v1: use the same version on both sides"
    )


@pytest.mark.parametrize(
    ("access", "word"), [(None, "missing"), (Access(token="another"), "wrong")], ids=["missing", "wrong"]
)
def test_a_wrong_token(start_server, access: Access | None, word: str, monkeypatch) -> None:
    monkeypatch.setattr("client.streaming.access.find_key", lambda _port: None)  # as on another machine
    assert told(start_server(authenticator=Authenticator("a-token")).url, access=access) == (
        f"the token is {word}: use the URL that the server printed at its start, which ends in ?token=..."
    )


def test_a_room_with_another_key(start_server) -> None:
    room = SimpleNamespace(close=lambda: None, key_digest=None, name="kitchen")
    server = start_server(room_factory=lambda *_: room)
    wire = Wire(server.url)
    wire.say(Hello(client="test", camera=CAMERA, room="kitchen", room_key="right"))
    wire.hear()
    for key in ("wrong", None):
        assert told(server.url, room=RoomPlace("kitchen", key=key)) == (
            "room 'kitchen' has a key of its own, and this is not it: ask who opened it"
        )
    wire.hang_up()


def test_a_server_that_is_draining(start_server, lab, monkeypatch) -> None:
    server = start_server()
    with draining(server, lab, monkeypatch) as wire:
        assert wire.ending()[1] == GOODBYE
        assert told(server.url) == DRAINING
