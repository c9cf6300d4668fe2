"""Fixtures: hosts with fake pipelines behind an ingress on a real socket, and no Ray."""

from __future__ import annotations

import asyncio
import contextlib
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import uvicorn

from server.cluster.host import RoomHost
from server.cluster.ingress import Ingress, create_ingress_app
from server.cluster.quota import Quota
from server.cluster.room_directory import Address, RoomNotReady, RoomUnavailable
from server.service.edge.authenticator import Authenticator
from server.service.serve import listen, url_of
from server.service.service import Service
from tests.service.fakes import FAKE_DEVICE, Lab, fake_mesh
from tests.service.wire import Wire

IMPATIENT_S = 0.6
"""Of an ingress that is to give up. Otherwise it has the product's patience: on a busy machine a host takes seconds."""
TOKEN = "secret"


class TownPlaces:
    """Rooms on this machine: opened when they are asked for, as many as there are places."""

    def __init__(self, lab: Lab, places: int) -> None:
        self.lab = lab
        self.free = places
        self.hosts: dict[str, RoomHost] = {}
        self.moving: set[str] = set()
        self.private: set[str] = set()
        self.abandoned: list[str] = []
        self.asked = 0
        self.quota = Quota(100)

    async def find(self, room_id: str, may_open: bool, client: str = "", *, is_private: bool = False) -> Address:
        self.asked += 1
        if room_id in self.moving:
            raise RoomNotReady(room_id)
        if room_id not in self.hosts:
            if not may_open:
                raise RoomUnavailable("there is no such session")
            if not self.quota.claim(room_id, client, self.hosts):
                raise RoomUnavailable(f"your address {client} has {self.quota.most} rooms open: close one of them")
            if not self.free:
                raise RoomNotReady("no place is free")
            self.free -= 1
            self.open(room_id)
            if is_private:
                self.private.add(room_id)
        return self.hosts[room_id].address()

    async def release(self, room_id: str) -> bool:
        if not await asyncio.to_thread(self.hosts[room_id].leave):
            return False
        del self.hosts[room_id]
        self.free += 1
        return True

    async def abandon(self, room_id: str) -> None:
        self.abandoned.append(room_id)

    async def has_place(self) -> bool:
        return self.free > 0

    def open(self, room_id: str) -> None:
        service = Service(
            FAKE_DEVICE,  # type: ignore[arg-type]
            pipeline_factory=self.lab.build,
            room_factory=lambda _wishes, name: SimpleNamespace(name=name, key_digest=None, close=lambda: None),
            mesh_loader=fake_mesh,
        )
        self.hosts[room_id] = RoomHost(service, "127.0.0.1")


@pytest.fixture(autouse=True)
def keys_are_left_here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Tokens are not left where the user's programs look for them."""
    monkeypatch.setenv("PROBELESS_KEYS", str(tmp_path / "keys"))


@pytest.fixture
def lab() -> Lab:
    """What the test shares with the fake pipelines."""
    return Lab()


@pytest.fixture
def town(lab: Lab) -> Iterator[TownPlaces]:
    """Three places."""
    places = TownPlaces(lab, 3)
    yield places
    lab.release(1000)
    for host in places.hosts.values():
        host._server.stop()


@pytest.fixture
def ingress(town: TownPlaces) -> Ingress:
    """Before the town."""
    return Ingress(town, Authenticator(TOKEN))


class AsServe:
    """An app whose request is cancelled when its client leaves, as Serve does; it may not hear of that before."""

    def __init__(self, app: Any) -> None:
        self._app = app

    async def __call__(self, scope: Any, receive: Any, send: Any) -> None:
        async def hear() -> Any:
            event = await receive()
            if event["type"] == "websocket.disconnect":
                running.cancel()
                await asyncio.Event().wait()
            return event

        running = asyncio.create_task(self._app(scope, hear, send))
        with contextlib.suppress(asyncio.CancelledError):
            await running


@contextlib.contextmanager
def served(app: Any) -> Iterator[str]:
    """The address of an app."""
    config = uvicorn.Config(app, log_config=None, ws_per_message_deflate=False, ws_max_size=32 << 20)
    server = uvicorn.Server(config)
    with listen("127.0.0.1", 0) as listener:
        thread = threading.Thread(target=server.run, args=([listener],), daemon=True)
        thread.start()
        yield url_of(listener)
        server.should_exit = True
        server.force_exit = True
        thread.join()


@pytest.fixture
def ingress_url(ingress: Ingress) -> Iterator[str]:
    """Of the ingress."""
    with served(create_ingress_app(ingress)) as url:
        yield url


@pytest.fixture
def dial(ingress_url: str) -> Iterator[Callable[..., Wire]]:
    """Open sockets to the ingress; closed at the end."""
    wires: list[Wire] = []

    def open_wire(token: str = TOKEN) -> Wire:
        wires.append(Wire(ingress_url, Authorization=f"Bearer {token}"))
        return wires[-1]

    yield open_wire
    for wire in wires:
        wire.hang_up()
