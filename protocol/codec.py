"""Encodes and decodes messages: MessagePack with typed validation. The size is checked before decoding."""

from __future__ import annotations

from typing import Any, TypeVar

import msgspec

from protocol.limits import MAX_MESSAGE_BYTES, MAX_REASON_CHARS
from protocol.messages import ClientMessage, ServerMessage
from protocol.missing_fields import missing_fields

T = TypeVar("T")
_END_CHARS = 120
"""Characters that are kept of each end of a line that is too long."""


class ProtocolError(ValueError):
    """Received data is invalid. The message is one printable line, short enough for `Error.reason`."""

    def __init__(self, reason: str) -> None:
        super().__init__(one_line(reason))


def one_line(text: str) -> str:
    """`text` as one printable line of at most MAX_REASON_CHARS, since it may quote untrusted input.

    Longer text is shortened in the middle, because the name of the field is at the end.
    """
    most = 4 * MAX_REASON_CHARS
    ends = text if len(text) <= most else text[: most // 2] + text[-most // 2 :]
    line = " ".join("".join(c if c.isprintable() else " " for c in ends).split())
    if len(line) <= MAX_REASON_CHARS:
        return line
    return line[: MAX_REASON_CHARS - _END_CHARS - 1] + "…" + line[-_END_CHARS:]


_encoder = msgspec.msgpack.Encoder()
_client_decoder: msgspec.msgpack.Decoder[ClientMessage] = msgspec.msgpack.Decoder(ClientMessage)
_server_decoder: msgspec.msgpack.Decoder[ServerMessage] = msgspec.msgpack.Decoder(ServerMessage)


def encode(message: ClientMessage | ServerMessage) -> bytes:
    """Encode a message as MessagePack. Raises ProtocolError if it exceeds the size that the other side accepts."""
    data = _encoder.encode(message)
    _require_size(len(data))
    return data


def decode_client(data: bytes | bytearray | memoryview) -> ClientMessage:
    """Decode a client's message. Raises ProtocolError, naming the field as `$.depth.width`."""
    return _decode(_client_decoder, data, ClientMessage)


def decode_server(data: bytes | bytearray | memoryview) -> ServerMessage:
    """Decode a server's message. Raises ProtocolError, naming the field as `$.light.sh`."""
    return _decode(_server_decoder, data, ServerMessage)


def _decode(decoder: msgspec.msgpack.Decoder[T], data: bytes | bytearray | memoryview, union: Any) -> T:
    _require_size(memoryview(data).nbytes)
    try:
        return decoder.decode(data)
    except (msgspec.MsgspecError, UnicodeDecodeError) as error:
        missing = missing_fields(data, union) if "missing required field" in str(error) else []
        if len(missing) > 1:
            raise ProtocolError(f"not a valid message: required fields are missing: {', '.join(missing)}") from error
        raise ProtocolError(f"not a valid message: {error}") from error
    except RecursionError as error:
        raise ProtocolError("not a valid message: lists or maps in it are nested too deeply") from error


def _require_size(size_bytes: int) -> None:
    if size_bytes > MAX_MESSAGE_BYTES:
        raise ProtocolError(f"message of {size_bytes} bytes exceeds the limit of {MAX_MESSAGE_BYTES} bytes")
