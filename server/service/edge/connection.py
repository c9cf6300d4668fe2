"""One client's WebSocket: typed messages in, bytes out. Every close has a code and a reason."""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import Callable

import msgspec
from fastapi import WebSocket, WebSocketDisconnect

from protocol.codec import ProtocolError, decode_client, encode, one_line
from protocol.limits import SUBPROTOCOL, SUBPROTOCOL_PREFIX
from protocol.messages import Acknowledged, Bye, ClientMessage, Dropped, Error, Index, ServerMessage
from server.service.edge.rate_limiter import RateLimiter
from server.service.limits import DEFAULT_LIMITS, Limits

NORMAL, PROTOCOL, UNSUPPORTED, INVALID, POLICY, INTERNAL, TRY_LATER = 1000, 1002, 1003, 1007, 1008, 1011, 1013
RESTART, GOING_AWAY, NO_CODE, LOST = 1012, 1001, 1005, 1006
UNAUTHORIZED, FORBIDDEN, GONE = 4401, 4403, 4410

MAX_CLOSE_REASON_BYTES = 123
SEND_PATIENCE_S = 30.0
CLOSE_PATIENCE_S = 5.0

CONTROL_TYPES = ("place_object", "move_object", "remove_object", "quality", "request_mesh", "request_panorama")


class Refusal(Exception):
    """The server ends this client's connection: a close code and one line for the client."""

    def __init__(self, code: int, reason: str) -> None:
        super().__init__(one_line(reason))
        self.code = code
        self.reason = str(self)


class ClientGone(Exception):
    """The client has disconnected or has stopped reading; nothing can be sent to it."""


class BadMessage(Exception):
    """A message of a known type with an invalid field. The client gets `answer` and the session continues."""

    def __init__(self, answer: Dropped | Acknowledged) -> None:
        super().__init__()
        self.answer = answer


class Connection:
    """A WebSocket that speaks this protocol. Must be used on the event loop."""

    def __init__(
        self,
        websocket: WebSocket,
        limits: Limits = DEFAULT_LIMITS,
        on_refusal: Callable[[Refusal, str], None] = lambda _refusal, _address: None,
    ) -> None:
        """`on_refusal` is called with the client's address before a refused client receives the error."""
        self.address = "" if websocket.client is None else websocket.client.host
        self._websocket = websocket
        self._on_refusal = on_refusal
        self._rate_limiter = RateLimiter(limits)
        self._notified_of_rate = False
        self._closed = False
        self.is_lost = False
        """Whether the connection broke without a close frame from the client."""
        self.dismissal = ""
        """Why the server ended the connection of a client that did nothing wrong."""

    async def accept(self) -> bool:
        """Complete the handshake. False for a client of another protocol version, after an error that names ours."""
        offered: list[str] = self._websocket.scope["subprotocols"]
        if SUBPROTOCOL in offered:
            await self._websocket.accept(SUBPROTOCOL)
            return True
        # A browser shows the close reason only if the server selected one of the offered subprotocols.
        await self._websocket.accept(offered[0] if offered else None)
        await self.turn_away(Refusal(PROTOCOL, _wrong_version(offered)))
        return False

    async def receive(self) -> ClientMessage | None:
        """The next message, or None once the client has left. Raises BadMessage, or Refusal to end the connection."""
        event = await self._websocket.receive()
        if event["type"] == "websocket.disconnect":
            self._closed = True
            self.is_lost = event.get("code", LOST) not in (NORMAL, GOING_AWAY, NO_CODE)
            return None
        data = event.get("bytes")
        if data is None:
            raise Refusal(UNSUPPORTED, "a text message was received; every message is binary MessagePack")
        await self._limit_rate(len(data))
        try:
            return decode_client(data)
        except ProtocolError as error:
            raise _judge(data, str(error)) from error

    async def _limit_rate(self, size_bytes: int) -> None:
        """Enforce the rate limits: sleep for too many bytes, raise Refusal for too many messages."""
        if self._rate_limiter.exceeds_message_rate():
            raise Refusal(POLICY, self._rate_limiter.message_rate_error)
        pause_s = self._rate_limiter.pause_s(size_bytes)
        if pause_s <= 0:
            return
        if not self._notified_of_rate:
            self._notified_of_rate = True
            await self.send_message(Error(reason=self._rate_limiter.byte_rate_notice, fatal=False))
        await asyncio.sleep(pause_s)

    async def send(self, data: bytes) -> None:
        """Send encoded messages, waiting for a client that reads slowly. Raises ClientGone."""
        if self._closed:
            raise ClientGone
        try:
            async with asyncio.timeout(SEND_PATIENCE_S):
                await self._websocket.send_bytes(data)
        except (WebSocketDisconnect, RuntimeError, TimeoutError) as error:  # RuntimeError: closed by the keepalive
            self._closed = True
            raise ClientGone from error

    async def send_message(self, message: ServerMessage) -> None:
        """Encode and send one small message. Raises ClientGone."""
        await self.send(encode(message))

    async def refuse(self, refusal: Refusal) -> None:
        """Close with the reason, both in an error message and in the close frame."""
        self._on_refusal(refusal, self.address)
        with contextlib.suppress(ClientGone, TimeoutError):
            async with asyncio.timeout(CLOSE_PATIENCE_S):
                await self.send_message(Error(reason=refusal.reason, fatal=True))
        await self.close(refusal.code, refusal.reason)

    async def turn_away(self, refusal: Refusal) -> None:
        """Close with the reason in the close frame alone, for a client that may not read this protocol's messages."""
        self._on_refusal(refusal, self.address)
        await self.close(refusal.code, refusal.reason)

    async def dismiss(self, code: int, reason: str) -> None:
        """Send bye and close; for a client that did nothing wrong."""
        self.dismissal = reason
        with contextlib.suppress(ClientGone, TimeoutError):
            async with asyncio.timeout(CLOSE_PATIENCE_S):
                await self.send_message(Bye(reason=reason))
        await self.close(code, reason)

    async def close(self, code: int = NORMAL, reason: str = "") -> None:
        """Close the connection. Does nothing if it is closed already."""
        if self._closed:
            return
        self._closed = True
        with contextlib.suppress(WebSocketDisconnect, RuntimeError, TimeoutError):
            async with asyncio.timeout(CLOSE_PATIENCE_S):
                await self._websocket.close(code, _cut(reason))


def _cut(reason: str) -> str:
    """`reason`, cut to the size of a close frame."""
    return reason.encode()[:MAX_CLOSE_REASON_BYTES].decode(errors="ignore")


def _wrong_version(offered: list[str]) -> str:
    asked = next((name for name in offered if name.startswith(SUBPROTOCOL_PREFIX)), "no protocol version")
    return one_line(f"this server speaks {SUBPROTOCOL}, you asked for {asked[:24]}: use the same version on both sides")


class _Envelope(msgspec.Struct):
    """The fields that identify a message whose other fields are invalid."""

    type: str
    frame: Index | None = None
    request: Index | None = None


def _judge(data: bytes, reason: str) -> Refusal | BadMessage:
    """An invalid frame or control message is answered; any other invalid message ends the connection."""
    try:
        envelope = msgspec.msgpack.decode(data, type=_Envelope)
    except (msgspec.MsgspecError, UnicodeDecodeError, RecursionError):
        return Refusal(INVALID, reason)
    if envelope.type == "frame" and envelope.frame is not None:
        return BadMessage(Dropped(frame=envelope.frame, reason=reason))
    if envelope.type in CONTROL_TYPES and envelope.request is not None:
        return BadMessage(Acknowledged(request=envelope.request, error=reason))
    return Refusal(INVALID, reason)
