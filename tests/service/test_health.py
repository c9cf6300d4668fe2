"""Whether the process answers, takes new sessions, and works; what strangers learn of it."""

from __future__ import annotations

import asyncio
import threading

import httpx
import pytest

from server.service.app import create_app
from server.service.edge.authenticator import Authenticator
from server.service.limits import Limits
from server.service.self_check import CheckFailed
from server.service.serve import BackgroundServer
from server.service.service import Service
from tests.service.draining import draining
from tests.service.fakes import FAKE_DEVICE, PATIENCE_S, fake_mesh
from tests.service.http import get
from tests.service.wire import Wire

TOKEN = "a-token-of-this-test"
STRANGER, OURSELVES = "192.0.2.7", "127.0.0.1"


def statuses(server) -> tuple[int, int, int]:
    return tuple(get(server, path).status_code for path in ("/livez", "/readyz", "/healthz"))


def test_a_full_server_works_but_takes_no_new_session(start_server) -> None:
    server = start_server(max_sessions=1)
    assert statuses(server) == (200, 200, 200)
    wire = Wire(server.url)
    wire.greet()
    assert statuses(server) == (200, 503, 200)
    wire.hang_up()


def test_a_server_whose_device_has_no_time_left_takes_no_new_session(start_server, monkeypatch) -> None:
    server = start_server(limits=Limits(max_period_s=1.0))
    scheduler = server.service._scheduler
    monkeypatch.setattr(type(scheduler), "busy", property(lambda _: 3))
    monkeypatch.setattr(type(scheduler), "period_s", lambda _, newcomers=0: 0.5 + newcomers)
    assert statuses(server) == (200, 503, 200)


def test_one_that_drains_lives(start_server, lab, monkeypatch) -> None:
    server = start_server()
    with draining(server, lab, monkeypatch) as wire:
        wire.ending()
        assert statuses(server) == (200, 503, 503)


def test_one_that_prepares_lives(lab) -> None:
    warm = threading.Event()
    service = Service(
        FAKE_DEVICE, pipeline_factory=lab.build, mesh_loader=fake_mesh, warm_up=lambda _: warm.wait(PATIENCE_S)
    )
    with BackgroundServer(service) as server:
        assert statuses(server) == (200, 503, 503)
        warm.set()


def asked(service: Service, path: str, client: str, **headers: str) -> httpx.Response:
    """The answer to `client`, an address, once the service has been prepared."""

    async def ask() -> httpx.Response:
        app = create_app(service, authenticator=Authenticator(TOKEN))
        prepared = asyncio.Event()
        service.on_prepared = prepared.set
        async with app.router.lifespan_context(app):
            await prepared.wait()
            transport = httpx.ASGITransport(app, client=(client, 1))
            async with httpx.AsyncClient(transport=transport, base_url="http://test") as http:
                return await http.get(path, headers=headers)

    return asyncio.run(ask())


@pytest.fixture
def failed(lab) -> Service:
    """A service whose warm-up fails with what is nobody's business."""

    def fail(_: object) -> None:
        raise CheckFailed("light", "secret internals of /some/folder")

    return Service(FAKE_DEVICE, pipeline_factory=lab.build, mesh_loader=fake_mesh, warm_up=fail)


@pytest.fixture
def well(lab) -> Service:
    return Service(FAKE_DEVICE, pipeline_factory=lab.build, mesh_loader=fake_mesh)


@pytest.mark.parametrize("path", ["/readyz", "/healthz"])
def test_strangers_learn_yes_or_no(path: str, well: Service, failed: Service) -> None:
    said = asked(well, path, STRANGER)
    assert (said.status_code, said.json()) == (200, {"ready": True})
    assert said.headers["cache-control"] == "no-store"
    said = asked(failed, path, STRANGER)
    assert (said.status_code, said.json()) == (503, {"ready": False})


def test_a_failed_server_lives_and_says_no_more(failed: Service) -> None:
    said = asked(failed, "/livez", OURSELVES)
    assert (said.status_code, said.text) == (200, "ok\n")


def test_operators_learn_why(failed: Service) -> None:
    assert asked(failed, "/healthz", OURSELVES).json()["failed_check"] == "light"


def test_whoever_has_the_token_learns_why(failed: Service) -> None:
    told = asked(failed, "/healthz", STRANGER, Authorization=f"Bearer {TOKEN}").json()
    assert "secret internals" in told["failure"]
