"""A blocking socket of the protocol that may also say what is wrong."""

from __future__ import annotations

import socket as tcp
from typing import Any
from urllib.parse import urlencode, urlsplit, urlunsplit

import msgpack
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import connect
from websockets.typing import Subprotocol

from protocol.codec import ProtocolError, decode_server
from protocol.conformance.report import Broken
from protocol.limits import SUBPROTOCOL

PATIENCE_S = 120.0
"""How long an answer may take: a first frame compiles kernels."""


class Socket:
    """One connection; messages are plain maps."""

    def __init__(
        self, url: str, token: str | None, patience_s: float = PATIENCE_S, subprotocol: str = SUBPROTOCOL
    ) -> None:
        parts = urlsplit(url)
        scheme = {"http": "ws", "https": "wss"}.get(parts.scheme, parts.scheme)
        query = urlencode({"token": token}) if token else ""
        address = urlunsplit((scheme, parts.netloc, "/v1/stream", query, ""))
        self._socket = connect(
            address,
            subprotocols=[Subprotocol(subprotocol)],
            compression=None,
            max_size=None,
            proxy=None,
        ).__enter__()  # closed by `close`
        self._patience_s = patience_s
        self.subprotocol = self._socket.subprotocol

    def say(self, message: dict[str, Any] | bytes | str) -> None:
        """Send a message, or bytes or text as they are. A server that has closed is noticed when its answer is read."""
        try:
            self._socket.send(msgpack.packb(message) if isinstance(message, dict) else message)
        except ConnectionClosed:
            return

    def hear(self) -> dict[str, Any]:
        """The next message, valid by the definitions. Raises Broken for anything else."""
        try:
            data = self._socket.recv(timeout=self._patience_s)
        except ConnectionClosed as closed:
            code, reason = (1006, "") if closed.rcvd is None else (closed.rcvd.code, closed.rcvd.reason)
            raise Broken(f"the server closed with {code} {reason!r}") from closed
        except TimeoutError as error:
            raise Broken(f"no answer within {self._patience_s:g} s") from error
        if isinstance(data, str):
            raise Broken("a text message was received")
        try:
            decode_server(data)
        except ProtocolError as error:
            raise Broken(str(error)) from error
        message: dict[str, Any] = msgpack.unpackb(data)
        return message

    def hear_a(self, *kinds: str) -> dict[str, Any]:
        """The next message, which must be of one of these types."""
        message = self.hear()
        if message["type"] not in kinds:
            raise Broken(f"{_told(message)} came, not {' or '.join(kinds)}")
        return message

    def ending(self) -> tuple[int, str, list[dict[str, Any]]]:
        """Read to the end: close code, reason, and the messages before."""
        messages = []
        try:
            while True:
                data = self._socket.recv(timeout=self._patience_s)
                messages.append(msgpack.unpackb(data) if isinstance(data, bytes) else {"type": "text"})
                if messages[-1]["type"] == "welcome":
                    raise Broken("welcome came, not a close frame")
        except ConnectionClosed as closed:
            close = closed.rcvd
            return (1006, "", messages) if close is None else (close.code, close.reason, messages)
        except TimeoutError as error:
            raise Broken(f"the connection was not closed within {self._patience_s:g} s") from error

    def cut(self) -> None:
        """Break the connection without a close frame."""
        self._socket.socket.shutdown(tcp.SHUT_RDWR)

    def close(self) -> None:
        """Close, if it is still open."""
        self._socket.close()


def _told(message: dict[str, Any]) -> str:
    reason = message.get("reason") or message.get("error")
    return f"{message['type']} ({reason})" if reason else str(message["type"])
