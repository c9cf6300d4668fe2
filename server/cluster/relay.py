"""Relays messages and close codes between one client and its room's host."""

from __future__ import annotations

import asyncio
import contextlib
from typing import Any

from fastapi import WebSocket, WebSocketDisconnect
from websockets.asyncio.client import ClientConnection, connect
from websockets.exceptions import ConnectionClosed
from websockets.protocol import State
from websockets.typing import Subprotocol

from protocol.limits import MAX_MESSAGE_BYTES, SUBPROTOCOL
from server.cluster.room_directory import Address
from server.cluster.routing import outgoing
from server.service.edge.connection import GOING_AWAY, INTERNAL, LOST, NO_CODE, NORMAL, RESTART

STREAM_PATH = "/v1/stream"
OPEN_PATIENCE_S = 5.0
READ_AHEAD = 2
"""Messages, beside those in the socket's own queue."""
PING_S, PING_PATIENCE_S = 5.0, 10.0
"""A host that does not answer is given up after the sum of both."""
MOVED = "the machine of this room has failed and the room moves to another one: connect again"


async def open_host(address: Address) -> ClientConnection:
    """Connect to a host. Raises OSError, TimeoutError, websockets' InvalidHandshake."""
    return await connect(
        address.url + STREAM_PATH,
        additional_headers={"Authorization": f"Bearer {address.token}"},
        subprotocols=[Subprotocol(SUBPROTOCOL)],
        compression=None,
        max_size=None,
        max_queue=2,
        open_timeout=OPEN_PATIENCE_S,
        ping_interval=PING_S,
        ping_timeout=PING_PATIENCE_S,
        proxy=None,
    )


class ClientEvents:
    """What a client sends, read ahead a little, so that its leaving is seen while its room is being opened."""

    def __init__(self, client: WebSocket) -> None:
        self._client = client
        self._events: asyncio.Queue[Any] = asyncio.Queue(READ_AHEAD)
        self.has_left = asyncio.Event()
        self._reading = asyncio.create_task(self._read())

    async def _read(self) -> None:
        is_open = True
        while is_open:
            event = await self._client.receive()
            is_open = event["type"] != "websocket.disconnect"
            if not is_open:
                self.has_left.set()
            await self._events.put(event)

    async def next(self) -> Any:
        """The next event of ASGI."""
        return await self._events.get()

    def close(self) -> None:
        """Read no more."""
        self._reading.cancel()


async def relay(client: WebSocket, events: ClientEvents, host: ClientConnection, room_id: str) -> None:
    """Relay until either side closes, then close the other side. `events`: what the client sends."""
    up = asyncio.create_task(_client_to_host(events, host))
    down = asyncio.create_task(_host_to_client(client, host, room_id))
    try:
        await asyncio.wait((up, down), return_when=asyncio.FIRST_COMPLETED)
    finally:
        for task in (up, down):
            task.cancel()
        ended = await asyncio.gather(up, down, return_exceptions=True)
    if host.state is not State.CLOSED:
        host.transport.abort()  # no close frame: the host must see a lost connection, which can be resumed
    for error in ended:
        if isinstance(error, Exception):
            raise error


async def _client_to_host(events: ClientEvents, host: ClientConnection) -> None:
    while True:
        event = await events.next()
        if event["type"] == "websocket.disconnect":
            code = event.get("code", LOST)
            if code in (NORMAL, GOING_AWAY):  # uvicorn reports NO_CODE for broken connections too
                await host.close(code)
            return
        data = event.get("bytes")
        if data is not None and len(data) > MAX_MESSAGE_BYTES:
            data = data[: MAX_MESSAGE_BYTES + 1]  # still too large, so that the host refuses it
        with contextlib.suppress(ConnectionClosed):  # the other direction closes with the reason
            await host.send(event["text"] if data is None else data)


async def _host_to_client(client: WebSocket, host: ClientConnection, room_id: str) -> None:
    try:
        while True:
            data = await host.recv(decode=False)
            await client.send_bytes(outgoing(data, room_id))
    except ConnectionClosed as closed:
        code, reason = (RESTART, MOVED) if closed.rcvd is None else (closed.rcvd.code, closed.rcvd.reason)
        if closed.rcvd is not None and code in (NO_CODE, LOST):
            code = INTERNAL
        with contextlib.suppress(RuntimeError, WebSocketDisconnect):  # the client has closed already
            await client.close(code, reason)
    except (RuntimeError, WebSocketDisconnect):
        pass  # the client has left; the other direction handles it
