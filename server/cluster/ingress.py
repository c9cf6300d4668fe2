"""Ingress replica: relays each client's socket to its room's host; serves the web page and a health check."""

from __future__ import annotations

import asyncio
import logging
from pathlib import Path

from fastapi import FastAPI, WebSocket
from fastapi.staticfiles import StaticFiles
from websockets.asyncio.client import ClientConnection
from websockets.exceptions import InvalidHandshake

from protocol.messages import ClientMessage
from server.cluster.relay import open_host, relay
from server.cluster.room_directory import RoomDirectory, RoomNotReady, RoomUnavailable
from server.cluster.routing import Route, route_of
from server.service.app import PAGE_FOLDER, STREAM_PATH
from server.service.edge.authenticator import Authenticator
from server.service.edge.connection import GONE, POLICY, TRY_LATER, BadMessage, Connection, Refusal
from server.service.limits import DEFAULT_LIMITS, Limits
from server.service.routes.health_routes import Health, add_health
from server.service.routes.object_library import ObjectLibrary
from server.service.routes.object_routes import add_objects

RETRY_S = 0.25
PATIENCE_S = 20.0
"""Time limit for a room to be opened or moved."""

log = logging.getLogger(__name__)


class Ingress:
    """One replica with any number of client sockets."""

    def __init__(
        self,
        directory: RoomDirectory,
        authenticator: Authenticator,
        limits: Limits = DEFAULT_LIMITS,
        patience_s: float = PATIENCE_S,
    ) -> None:
        self._directory = directory
        self.authenticator = authenticator
        self._limits = limits
        self._patience_s = patience_s
        self.clients = 0

    async def serve(self, websocket: WebSocket) -> None:
        """Serve one client from its handshake to its end."""
        connection = Connection(websocket, self._limits)
        if not await connection.accept():
            return
        self.clients += 1
        try:
            if (refusal := await self.authenticator.slowed_refusal(websocket)) is not None:
                raise refusal
            route = route_of(await self._first_message(connection))
            async with await self._host_of(route) as host:
                await host.send(route.first)
                await relay(websocket, host, route.room_id)
        except Refusal as refused:
            extra = {"address": connection.address, "code": refused.code, "reason": refused.reason}
            log.info("client refused", extra=extra)
            await connection.refuse(refused)
        finally:
            self.clients -= 1

    async def _first_message(self, connection: Connection) -> ClientMessage | None:
        try:
            async with asyncio.timeout(self._limits.first_message_s):
                return await connection.receive()
        except BadMessage as bad:
            raise Refusal(POLICY, "the first message must be hello or watch") from bad
        except TimeoutError as late:
            raise Refusal(POLICY, f"neither hello nor watch came within {self._limits.first_message_s:g} s") from late

    async def _host_of(self, route: Route) -> ClientConnection:
        """Connect to the room's host; waits while the room is opened or moved. Raises Refusal."""
        try:
            async with asyncio.timeout(self._patience_s):
                while True:
                    try:
                        return await open_host(await self._directory.find(route.room_id, route.may_open))
                    except (RoomNotReady, OSError, InvalidHandshake) as why:  # TimeoutError is an OSError
                        log.debug("room %s has no host yet: %s", route.room_id, why)
                    await asyncio.sleep(RETRY_S)
        except TimeoutError as late:
            raise Refusal(TRY_LATER, "no machine has a place for this room yet: try again in a minute") from late
        except RoomUnavailable as none:
            raise Refusal(TRY_LATER if route.may_open else GONE, str(none)) from none


def create_ingress_app(ingress: Ingress, page_folder: Path = PAGE_FOLDER) -> FastAPI:
    """The ASGI application of one replica."""
    app = FastAPI(openapi_url=None)

    @app.websocket(STREAM_PATH)
    async def stream(websocket: WebSocket) -> None:
        await ingress.serve(websocket)

    add_health(app, lambda: Health(True, True, {"clients": ingress.clients}), ingress.authenticator)
    add_objects(app, ObjectLibrary(), ingress.authenticator)
    if (page_folder / "index.html").is_file():
        app.mount("/", StaticFiles(directory=page_folder, html=True))
    return app
