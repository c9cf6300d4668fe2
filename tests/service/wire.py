"""A client that says exactly what a test wants, right or wrong."""

from __future__ import annotations

import socket

import pytest
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import connect

from protocol.codec import decode_server, encode
from protocol.limits import SUBPROTOCOL
from protocol.messages import ClientMessage, Hello, ServerMessage, Watch, Welcome, Wishes
from tests.service.fakes import CAMERA, PATIENCE_S


class Wire:
    """A blocking socket of the protocol."""

    def __init__(
        self,
        url: str,
        subprotocols: tuple[str, ...] = (SUBPROTOCOL,),
        receive_buffer_bytes: int | None = None,
        path: str = "/v1/stream",
        called: str | None = None,
        **headers: str,
    ) -> None:
        """`receive_buffer_bytes`: as little as the kernel allows, for a client that reads slowly.

        `called`: a URL by which the client believes to know the server at `url`.
        """
        self.socket = connect(
            (called or url).replace("http", "ws") + path,
            sock=_tcp(url, receive_buffer_bytes),
            max_queue=1 if receive_buffer_bytes else None,
            subprotocols=subprotocols or None,
            additional_headers=headers,
            compression=None,
            max_size=None,
            proxy=None,
            open_timeout=PATIENCE_S,  # a server that starts again on a busy machine answers late
        ).__enter__()  # closed by `hang_up`

    def say(self, *messages: ClientMessage) -> None:
        """Send messages."""
        for message in messages:
            self.socket.send(encode(message))

    def hear(self) -> ServerMessage:
        """The next message."""
        return decode_server(self.socket.recv(timeout=PATIENCE_S))

    def hear_until(self, kind: type) -> list[ServerMessage]:
        """Messages up to the first of a kind, which is the last of them."""
        messages = [self.hear()]
        while not isinstance(messages[-1], kind):
            messages.append(self.hear())
        return messages

    def greet(self, **wishes: object) -> Welcome:
        """Say hello and take the welcome."""
        self.say(Hello(client="test", camera=CAMERA, wishes=Wishes(**wishes)))
        return self._take_welcome()

    def watch(self, session: str | None = None) -> Welcome:
        """Ask to watch and take the welcome."""
        self.say(Watch(session=session))
        return self._take_welcome()

    def _take_welcome(self) -> Welcome:
        welcome = self.hear()
        assert isinstance(welcome, Welcome), welcome
        return welcome

    def ending(self) -> tuple[int, str, list[ServerMessage]]:
        """Read to the end: the close code and reason, and what came before."""
        messages: list[ServerMessage] = []
        with pytest.raises(ConnectionClosed) as ended:
            messages.extend(iter(self.hear, None))
        close = ended.value.rcvd
        assert close is not None, "the connection ended without a close frame (1006)"
        return close.code, close.reason, messages

    def hang_up(self) -> None:
        """Close, if it is still open."""
        self.socket.close()


def _tcp(url: str, receive_buffer_bytes: int | None) -> socket.socket:
    host, port = url.removeprefix("http://").split(":")
    tcp = socket.socket()
    if receive_buffer_bytes is not None:
        tcp.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, receive_buffer_bytes)
    try:
        tcp.connect((host, int(port)))
    except OSError:
        tcp.close()
        raise
    tcp.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, True)
    return tcp
