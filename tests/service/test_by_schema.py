"""The HTTP side keeps to its own description, whatever is asked."""

from __future__ import annotations

from fastapi import FastAPI, Response

from server.service.app import create_app
from server.service.edge.authenticator import Authenticator
from server.service.serve import BackgroundServer
from server.service.service import Service
from tests.service.by_schema import requests_by_schema
from tests.service.fakes import FAKE_DEVICE

EXAMPLES = 15


def test_every_answer_is_described(server) -> None:
    found = requests_by_schema(create_app(Service(FAKE_DEVICE)), server.url, EXAMPLES)
    assert not found.wrong
    paths = (
        "/livez",
        "/readyz",
        "/healthz",
        "/metrics",
        "/v1/objects",
        "/v1/objects/{name}",
        "/v1/panorama.hdr",
        "/v1/panorama.exr",
    )
    assert set(found.requests) == {f"GET {path}" for path in paths}
    assert found.requests["GET /v1/objects/{name}"] >= EXAMPLES


def test_refusals_are_described() -> None:
    with BackgroundServer(Service(FAKE_DEVICE), authenticator=Authenticator("secret")) as guarded:
        url = guarded.url.partition("?")[0].rstrip("/")
        found = requests_by_schema(create_app(Service(FAKE_DEVICE)), url, EXAMPLES)
    assert not found.wrong


def test_an_answer_that_is_not_described_is_seen(server) -> None:
    app = FastAPI()

    @app.get("/healthz", responses={200: {"content": {"text/html": {}}}}, response_class=Response)
    def other() -> None: ...

    assert "Content-Type" in requests_by_schema(app, server.url, 2).wrong[0]
