"""A WebSocket that lets a client read why it was cut off.

A message over the size limit, or one that breaks the WebSocket protocol, fails while the client is still sending. If
the server closed at once, the unread rest would make the kernel reset the connection, and the close frame with its
code and reason would be lost. So what still comes is read and thrown away until the client has fallen silent.
"""

from __future__ import annotations

from asyncio import TimerHandle

from uvicorn.protocols.websockets.websockets_sansio_impl import WebSocketsSansIOProtocol

SILENCE_S = 0.5


class LingeringWebSocket(WebSocketsSansIOProtocol):
    """uvicorn's WebSocket, but for the end of a connection whose client broke the protocol."""

    _silence: TimerHandle | None = None

    def data_received(self, data: bytes) -> None:
        """Handle what came, or throw it away once the connection has failed."""
        if self._silence is None:
            super().data_received(data)
        else:
            self._await_silence()

    def connection_lost(self, exc: Exception | None) -> None:
        """Say that it was lost: uvicorn's own code is that of a close frame without one. The first word counts."""
        self.queue.put_nowait({"type": "websocket.disconnect", "code": 1006})
        super().connection_lost(exc)

    def handle_parser_exception(self) -> None:
        """Send the close frame, tell the app, and close when the client is silent or `close_timeout` is over."""
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
