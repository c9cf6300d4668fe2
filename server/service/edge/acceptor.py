"""Accepts connections for uvicorn: within the gate's limits, and with a time limit for each request's header."""

from __future__ import annotations

import asyncio
import contextlib
import logging
import socket
from asyncio import TimerHandle
from collections.abc import Callable
from typing import Any

import uvicorn
from uvicorn.protocols.http.httptools_impl import HttpToolsProtocol

from server.service.edge.gate import Gate, Place
from server.service.edge.lingering_close import LingeringCloseWebSocket

ACCEPT_PAUSE_S = 0.2
"""Pause after the system could not give a socket, since it would fail again at once."""
TLS_CLOSE_S = 5.0

log = logging.getLogger(__name__)


class TimedHttp(HttpToolsProtocol):
    """uvicorn's HTTP/1.1 with a time limit for each request's header; has a place in the gate."""

    place: Place
    header_s: float
    _header_timer: TimerHandle | None = None

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        """Begin to wait for the first header."""
        super().connection_made(transport)
        self.place.drop = transport.abort
        self._note_progress()

    def data_received(self, data: bytes) -> None:
        """Parse. The time for a header is not prolonged by parts of it."""
        super().data_received(data)
        self._note_progress()

    def on_response_complete(self) -> None:
        """Begin to wait for the next header."""
        super().on_response_complete()
        self._note_progress()

    def handle_websocket_upgrade(self) -> None:
        """The WebSocket takes over the place; it is silent until its first message."""
        super().handle_websocket_upgrade()
        websocket = self.transport.get_protocol()
        assert isinstance(websocket, LingeringCloseWebSocket)
        websocket.place = self.place

    def connection_lost(self, exc: Exception | None) -> None:
        """Free the place."""
        self._stop_timer()
        self.place.leave()
        super().connection_lost(exc)

    def _note_progress(self) -> None:
        if isinstance(self.transport.get_protocol(), LingeringCloseWebSocket):
            self._stop_timer()
            return
        waits = self.cycle is None or self.cycle.response_complete
        self.place.set_silent(waits)
        if not waits:
            self._stop_timer()
        elif self._header_timer is None:
            self._header_timer = self.loop.call_later(self.header_s, self._give_up)

    def _stop_timer(self) -> None:
        if self._header_timer is not None:
            self._header_timer.cancel()
            self._header_timer = None

    def _give_up(self) -> None:
        self._header_timer = None
        self.place.note(f"no complete request came within {self.header_s:g} s")
        self.transport.abort()


class Acceptor:
    """Accepts the connections of one listening socket. Must be used on the event loop."""

    def __init__(
        self, listener: socket.socket, gate: Gate, config: uvicorn.Config, open_protocol: Callable[[Place], TimedHttp]
    ) -> None:
        """Starts to accept. `open_protocol` makes the protocol of a new connection."""
        self._gate, self._ssl, self._open_protocol = gate, config.ssl, open_protocol
        self._opening: set[asyncio.Task[None]] = set()
        listener.setblocking(False)
        listener.listen(config.backlog)
        self._task = asyncio.create_task(self._accept_all(listener))

    async def stop(self) -> None:
        """Accept no more. Connections stay open."""
        self._task.cancel()
        with contextlib.suppress(asyncio.CancelledError):
            await self._task

    async def _accept_all(self, listener: socket.socket) -> None:
        loop = asyncio.get_running_loop()
        while True:
            try:
                accepted, address = await loop.sock_accept(listener)
            except OSError as error:  # no descriptor or memory is left, or the client has gone
                log.warning("a connection could not be accepted: %s", error)
                await asyncio.sleep(ACCEPT_PAUSE_S)
                continue
            self._admit(accepted, str(address[0]))
            await asyncio.sleep(0)  # others are served between two that are accepted

    def _admit(self, accepted: socket.socket, address: str) -> None:
        place = self._gate.enter(address)
        if place is None:
            accepted.close()
            return
        task = asyncio.create_task(self._open(accepted, place))
        place.drop = task.cancel
        self._opening.add(task)
        task.add_done_callback(self._opening.discard)

    async def _open(self, accepted: socket.socket, place: Place) -> None:
        """Make the transport and, with TLS, wait for its handshake."""
        loop = asyncio.get_running_loop()
        protocol = self._open_protocol(place)
        options: dict[str, Any] = {}
        if self._ssl is not None:
            times = {"ssl_handshake_timeout": protocol.header_s, "ssl_shutdown_timeout": TLS_CLOSE_S}
            options = {"ssl": self._ssl, **times}
        try:
            await loop.connect_accepted_socket(lambda: protocol, accepted, **options)
        except OSError as error:  # ssl.SSLError and timeouts, too
            place.note(f"no connection could be made: {type(error).__name__}")
            place.leave()
        except asyncio.CancelledError:
            place.leave()
            accepted.close()
            raise
