"""Health over HTTP: `/livez` (the process answers), `/readyz` (it takes new sessions) and `/healthz` (it works).

Strangers learn no more than yes or no. Why, and what the server holds, is told to this machine and to whoever has the
token.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

from fastapi import FastAPI, Request
from fastapi.responses import JSONResponse, PlainTextResponse, Response

from server.service.edge.authenticator import Authenticator

FRESH = {"cache-control": "no-store"}


@dataclass(frozen=True)
class Health:
    """What is answered now."""

    works: bool
    """The self-check has passed and the server is not draining."""
    takes_sessions: bool
    """It works and has room for another session."""
    details: dict[str, object] = field(default_factory=dict)
    """For those who may see metrics; JSON values."""


def add_health(app: FastAPI, health: Callable[[], Health], authenticator: Authenticator) -> None:
    """Add the three routes. `health` is called for each request, on the event loop; it must not wait."""

    @app.get("/livez", response_class=PlainTextResponse)
    async def livez() -> Response:
        return PlainTextResponse("ok\n", headers=FRESH)

    @app.get("/readyz", responses=_described("No new session is taken now"))
    async def readyz() -> JSONResponse:
        return _answer(health().takes_sessions, {})

    @app.get("/healthz", responses=_described("Not ready: what is missing is in the answer, for who may see it"))
    async def healthz(request: Request) -> JSONResponse:
        now = health()
        return _answer(now.works, now.details if authenticator.shows_metrics_to(request) else {})


def _answer(ready: bool, details: dict[str, object]) -> JSONResponse:
    return JSONResponse({"ready": ready, **details}, status_code=200 if ready else 503, headers=FRESH)


def _described(description: str) -> dict[int | str, dict[str, Any]]:
    return {503: {"description": description}}
