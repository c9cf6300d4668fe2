"""Ingress replica: relays each client's socket to its room's host; serves the web page and a health check."""

from __future__ import annotations

import asyncio
import logging
import time
from collections.abc import Coroutine
from pathlib import Path
from typing import Any

from fastapi import FastAPI, WebSocket
from fastapi.staticfiles import StaticFiles
from uvicorn.middleware.proxy_headers import ProxyHeadersMiddleware
from websockets.asyncio.client import ClientConnection
from websockets.exceptions import InvalidHandshake

from protocol.messages import ClientMessage
from server.cluster.ingress_metrics import IngressMetrics
from server.cluster.quota import client_of
from server.cluster.relay import ClientEvents, open_host, relay
from server.cluster.room_directory import RoomDirectory, RoomNotReady, RoomUnavailable
from server.cluster.routing import Route, route_of
from server.service.app import PAGE_FOLDER, STREAM_PATH
from server.service.edge.authenticator import Authenticator
from server.service.edge.connection import GONE, POLICY, TRY_LATER, BadMessage, Connection, Refusal
from server.service.limits import DEFAULT_LIMITS, Limits
from server.service.routes.health_routes import Health, add_health
from server.service.routes.metrics_route import add_metrics
from server.service.routes.object_library import ObjectLibrary
from server.service.routes.object_routes import add_objects

RETRY_S = 0.25
RELEASE_TRIES = 8
FRESH_S = 2.0
"""Time for which it is believed that there is a place, or none."""
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
        self.metrics = IngressMetrics()
        self.clients = 0
        self._has_place, self._asked_s = True, -FRESH_S
        self._background: set[asyncio.Task[Any]] = set()

    async def serve(self, websocket: WebSocket) -> None:
        """Serve one client from its handshake to its end."""
        connection = Connection(websocket, self._limits)
        if not await connection.accept():
            return
        self.clients += 1
        self.metrics.clients.set(self.clients)
        try:
            if (refusal := await self.authenticator.slowed_refusal(websocket)) is not None:
                raise refusal
            await self._serve_route(websocket, connection, route_of(await self._first_message(connection)))
        except Refusal as refused:
            self.metrics.refused.labels(str(refused.code)).inc()
            extra = {"address": connection.address, "code": refused.code, "reason": refused.reason}
            log.info("client refused", extra=extra)
            await connection.refuse(refused)
        finally:
            self.clients -= 1
            self.metrics.clients.set(self.clients)

    async def _serve_route(self, websocket: WebSocket, connection: Connection, route: Route) -> None:
        """Relay to the room's host. A private room is closed when its client leaves, also before it is ready."""
        events = ClientEvents(websocket)
        is_connected = False
        try:
            client = client_of(connection.address, self.authenticator.proxies)
            if (host := await _unless_left(self._host_of(route, client), events)) is not None:
                is_connected = True
                async with host:
                    await host.send(route.first)
                    await relay(websocket, events, host, route.room_id)
        finally:
            events.close()
            if route.is_private:
                self._in_background(self._release(route.room_id) if is_connected else self._abandon(route.room_id))

    def _in_background(self, work: Coroutine[Any, Any, None]) -> None:
        task = asyncio.create_task(work)
        self._background.add(task)
        task.add_done_callback(self._background.discard)

    async def _release(self, room_id: str) -> None:
        for _ in range(RELEASE_TRIES):  # the host may not have seen yet that its client has left
            if await self._directory.release(room_id):
                return
            await asyncio.sleep(RETRY_S)

    async def _abandon(self, room_id: str) -> None:
        self.metrics.abandoned.inc()
        await self._directory.abandon(room_id)

    def health(self) -> Health:
        """Now; whether there is a place is asked for every FRESH_S."""
        now_s = time.monotonic()
        if now_s - self._asked_s >= FRESH_S:
            self._asked_s = now_s
            self._in_background(self._ask_for_place())
        return Health(True, self._has_place, {"clients": self.clients})

    async def _ask_for_place(self) -> None:
        self._has_place = await self._directory.has_place()
        self.metrics.has_place.set(float(self._has_place))

    async def _first_message(self, connection: Connection) -> ClientMessage | None:
        try:
            async with asyncio.timeout(self._limits.first_message_s):
                return await connection.receive()
        except BadMessage as bad:
            raise Refusal(POLICY, "the first message must be hello or watch") from bad
        except TimeoutError as late:
            raise Refusal(POLICY, f"neither hello nor watch came within {self._limits.first_message_s:g} s") from late

    async def _host_of(self, route: Route, client: str) -> ClientConnection:
        """Connect to the room's host; waits while the room is opened or moved. Raises Refusal."""
        began_s = time.monotonic()
        try:
            async with asyncio.timeout(self._patience_s):
                while True:
                    try:
                        address = await self._directory.find(
                            route.room_id, route.may_open, client, is_private=route.is_private
                        )
                        host = await open_host(address)
                    except (RoomNotReady, OSError, InvalidHandshake) as why:  # TimeoutError is an OSError
                        log.debug("room %s has no host yet: %s", route.room_id, why)
                    else:
                        self.metrics.wait_s.observe(time.monotonic() - began_s)
                        return host
                    await asyncio.sleep(RETRY_S)
        except TimeoutError as late:
            raise Refusal(TRY_LATER, "no machine has a place for this room yet: try again in a minute") from late
        except RoomUnavailable as none:
            raise Refusal(TRY_LATER if route.may_open else GONE, str(none)) from none


async def _unless_left(opening: Coroutine[Any, Any, ClientConnection], events: ClientEvents) -> ClientConnection | None:
    """The connection to a host; None where the client leaves before. Raises what `opening` does.

    Where it ends otherwise, as where Serve cancels it because its client has left, nothing is opened any more either.
    """
    opened, left = asyncio.create_task(opening), asyncio.create_task(events.has_left.wait())
    try:
        await asyncio.wait((opened, left), return_when=asyncio.FIRST_COMPLETED)
        return await opened if opened.done() else None
    finally:
        left.cancel()
        opened.cancel()


def create_ingress_app(ingress: Ingress, page_folder: Path = PAGE_FOLDER) -> FastAPI:
    """The ASGI application of one replica."""
    app = FastAPI(openapi_url=None)
    proxies = ingress.authenticator.proxies
    if proxies:
        app.add_middleware(ProxyHeadersMiddleware, trusted_hosts=proxies.for_uvicorn)

    @app.websocket(STREAM_PATH)
    async def stream(websocket: WebSocket) -> None:
        await ingress.serve(websocket)

    add_health(app, ingress.health, ingress.authenticator)
    add_metrics(app, ingress.metrics.render, ingress.authenticator)
    add_objects(app, ObjectLibrary(), ingress.authenticator)
    if (page_folder / "index.html").is_file():
        app.mount("/", StaticFiles(directory=page_folder, html=True))
    return app
