"""Lingering close for WebSockets, so that a client can read why it was disconnected.

A message that is too large or breaks the WebSocket protocol fails while the client is still sending. If the server
closed at once, the kernel would reset the connection because of the unread data, and the close frame with its code
and reason would be lost. Remaining data is therefore read and discarded until the client stops sending.
"""

from __future__ import annotations

from asyncio import TimerHandle

from uvicorn.protocols.websockets.websockets_sansio_impl import WebSocketsSansIOProtocol
from websockets.protocol import State

from server.service.edge.gate import Place

SILENCE_S = 0.5


class LingeringCloseWebSocket(WebSocketsSansIOProtocol):
    """uvicorn's WebSocket with a lingering close after protocol errors."""

    place: Place | None = None
    """Its place among the connections of the server."""
    _silence: TimerHandle | None = None

    def send_receive_event_to_app(self) -> None:
        """A message is complete: from the first one on, the connection is in use."""
        if self.place is not None:
            self.place.set_silent(False)
        super().send_receive_event_to_app()

    def data_received(self, data: bytes) -> None:
        """Handle received data; discard it once the connection has failed."""
        if self._silence is None:
            super().data_received(data)
        else:
            self._await_silence()

    def shutdown(self) -> None:
        """Close with code 1012; uvicorn would fail, and the server with it, where the client is closing already."""
        if self.handshake_complete and not self.close_sent and self.conn.state is not State.OPEN:
            self.stop_keepalive()
            self.transport.close()
        else:
            super().shutdown()

    def connection_lost(self, exc: Exception | None) -> None:
        """Report code 1006 (connection lost); uvicorn would report 1005. The first event in the queue counts."""
        if self.place is not None:
            self.place.leave()
        self.queue.put_nowait({"type": "websocket.disconnect", "code": 1006})
        super().connection_lost(exc)

    def handle_parser_exception(self) -> None:
        """Send the close frame, notify the app, and close when the client is silent or after `close_timeout`."""
        assert self.conn.close_sent is not None
        sent = self.conn.close_sent
        self.queue.put_nowait({"type": "websocket.disconnect", "code": sent.code, "reason": sent.reason})
        self.transport.write(b"".join(self.conn.data_to_send()))
        self.close_sent = True
        self.close_timer = self.loop.call_later(self.close_timeout, self.transport.close)
        self._await_silence()
        if self.read_paused:
            self.read_paused = False
            self.transport.resume_reading()

    def _await_silence(self) -> None:
        if self._silence is not None:
            self._silence.cancel()
        self._silence = self.loop.call_later(SILENCE_S, self.transport.close)
