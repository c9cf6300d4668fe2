"""HTTP and WebSocket routes of one service: stream, web page, objects, panoramas, health and metrics."""

from __future__ import annotations

import logging
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from pathlib import Path

from fastapi import FastAPI, WebSocket
from fastapi.responses import PlainTextResponse, Response

from server.service.edge.authenticator import Authenticator
from server.service.edge.connection import POLICY, Connection, Refusal
from server.service.routes.health_routes import Health, add_health
from server.service.routes.metrics_route import add_metrics
from server.service.routes.object_library import ObjectLibrary
from server.service.routes.object_routes import add_objects
from server.service.routes.page_files import PageFiles
from server.service.routes.panorama_routes import add_panorama
from server.service.service import Service
from server.service.ways_in import AUTHORITY_PATH

STREAM_PATH = "/v1/stream"
PAGE_FOLDER = Path(__file__).resolve().parents[2] / "client" / "web" / "dist"

log = logging.getLogger(__name__)


def create_app(
    service: Service,
    page_folder: Path = PAGE_FOLDER,
    authenticator: Authenticator | None = None,
    library: ObjectLibrary | None = None,
    authority: Path | None = None,
) -> FastAPI:
    """The ASGI application that starts, serves and stops `service`. `page_folder` holds index.html.

    `authenticator`: None lets every client in. `library`: objects that clients may place; None offers the vase only.
    `authority`: PEM of the certificate authority that devices may trust; None: there is none of the server's own.
    """
    authenticator = authenticator or Authenticator()

    @asynccontextmanager
    async def lifespan(_: FastAPI) -> AsyncIterator[None]:
        service.start()
        yield
        service.stop()

    app = FastAPI(lifespan=lifespan, openapi_url=None)
    _add_stream(app, service, authenticator)
    add_health(app, lambda: _health_of(service), authenticator)
    add_metrics(app, service.metrics.render, authenticator)
    add_objects(app, library or ObjectLibrary(), authenticator)
    add_panorama(app, service, authenticator)
    if authority is not None:
        _add_authority(app, authority)
    _add_page(app, page_folder)
    return app


def _add_stream(app: FastAPI, service: Service, authenticator: Authenticator) -> None:
    @app.websocket(STREAM_PATH)
    async def stream(websocket: WebSocket) -> None:
        connection = Connection(websocket, service.limits, service.note_refusal)
        if not await connection.accept():
            return
        try:
            with service.connection_limits.connected(connection.address):
                if (refusal := await authenticator.slowed_refusal(websocket)) is not None:
                    raise refusal
                await service.serve(connection)
        except Refusal as refused:
            await connection.refuse(refused)

    @app.websocket("/{path:path}")
    async def elsewhere(websocket: WebSocket) -> None:
        connection = Connection(websocket, service.limits, service.note_refusal)
        if await connection.accept():
            reason = f"there is no socket at this path; the stream is at {STREAM_PATH}"
            await connection.turn_away(Refusal(POLICY, reason))


def _health_of(service: Service) -> Health:
    details: dict[str, object] = {"device": service.device_name, "sessions": service.sessions}
    if service.storage is not None:
        details |= {"kept_rooms": service.storage.rooms, "kept_bytes": service.storage.space_bytes}
    if service.shutdown.is_draining:
        details["draining"] = True
    if service.failure is not None:
        details["failure"] = service.failure
    if service.failed_check is not None:
        details["failed_check"] = service.failed_check
    return Health(service.ready, service.takes_sessions, details)


def _add_authority(app: FastAPI, certificate: Path) -> None:
    """Public, as every certificate is: a device needs it before it trusts this server."""
    data = certificate.read_bytes()

    @app.get(AUTHORITY_PATH)
    async def authority() -> Response:
        return Response(data, media_type="application/x-x509-ca-cert")


def _add_page(app: FastAPI, page_folder: Path) -> None:
    if (page_folder / "index.html").is_file():
        app.mount("/", PageFiles(page_folder))
        return

    @app.get("/")
    async def no_page() -> PlainTextResponse:
        return PlainTextResponse(f"The page is not built: {page_folder.name}/index.html is missing.\n", status_code=404)
