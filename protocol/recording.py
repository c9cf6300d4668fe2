"""Recordings: the messages that a client sent or received, as consecutive MessagePack messages in a file."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import BinaryIO

import msgpack
import msgspec

from protocol.codec import ProtocolError, encode
from protocol.limits import MAX_MESSAGE_BYTES
from protocol.messages import ClientMessage, ServerMessage

AnyMessage = ClientMessage | ServerMessage


def write_message(file: BinaryIO, message: AnyMessage) -> None:
    """Append one message to an open recording. Raises ProtocolError if it exceeds the message limit."""
    file.write(encode(message))


def read_messages(path: Path, report: Callable[[str], None]) -> Iterator[AnyMessage]:
    """Iterate over the complete messages of a recording, without loading the whole file.

    If the recording ends inside a message (the recorder was interrupted), `report` is called with one line after the
    last complete message. Raises ProtocolError with the position for invalid bytes.
    """
    with path.open("rb") as file:
        unpacker = msgpack.Unpacker(file, max_buffer_size=MAX_MESSAGE_BYTES)
        start = 0
        try:
            while True:
                yield msgspec.convert(unpacker.unpack(), AnyMessage)
                start = unpacker.tell()
        except msgpack.OutOfData:
            left_over = path.stat().st_size - start
        except (msgpack.UnpackException, msgspec.ValidationError, ValueError) as error:
            reason = str(error) or type(error).__name__
            raise ProtocolError(f"{path}: no message of a recording at byte {start}: {reason}") from error
    if left_over:
        report(f"{path}: the last message is truncated ({left_over} bytes from byte {start}); it was left out")
