"""Fixtures: a service with fake pipelines on a real socket."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from server.service.serve import BackgroundServer
from tests.servers import start_fake
from tests.service.fakes import Lab
from tests.service.wire import Wire

StartServer = Callable[..., BackgroundServer]


@pytest.fixture(autouse=True)
def keys_are_left_here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Tokens are not left where the user's programs look for them."""
    monkeypatch.setenv("PROBELESS_KEYS", str(tmp_path / "keys"))


@pytest.fixture
def lab() -> Lab:
    """What the test shares with the fake pipelines."""
    return Lab()


@pytest.fixture
def start_server(lab: Lab) -> Iterator[StartServer]:
    """Start a server with fake pipelines; keywords go to `Service`. All are stopped at the end."""
    servers: list[BackgroundServer] = []

    def start(**options: object) -> BackgroundServer:
        servers.append(start_fake(lab.build, **options))
        return servers[-1]

    yield start
    lab.release(1000)
    for server in servers:
        server.stop()


@pytest.fixture
def server(start_server: StartServer) -> BackgroundServer:
    """A server with fake pipelines."""
    return start_server()


@pytest.fixture
def dial(server: BackgroundServer) -> Iterator[Callable[[], Wire]]:
    """Open sockets to the server; closed at the end."""
    wires: list[Wire] = []

    def open_wire() -> Wire:
        wires.append(Wire(server.url))
        return wires[-1]

    yield open_wire
    for wire in wires:
        wire.hang_up()
