"""A recording as a source: the frames that a client once sent, in their order."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from statistics import median

import msgpack
import msgspec
import numpy as np

from client.laptop.errors import SourceError
from client.progress import note
from protocol.codec import ProtocolError, decode_client
from protocol.frames import CameraModel, RgbdFrame
from protocol.images import decode_color, decode_depth
from protocol.limits import MAX_MESSAGE_BYTES
from protocol.messages import Frame, Hello

DEFAULT_FPS = 30.0


@dataclass(frozen=True)
class RecordedSource:
    """See client.laptop.source.Source; frames are read from the file when asked for."""

    path: Path
    camera: CameraModel
    up: tuple[float, float, float] | None
    fps: float
    has_poses: bool
    places: tuple[tuple[int, int], ...] = field(repr=False)
    """First byte and length of each frame's message."""

    @property
    def name(self) -> str:
        return self.path.name

    def __len__(self) -> int:
        return len(self.places)

    def __getitem__(self, index: int) -> RgbdFrame:
        index = range(len(self))[index]
        where = f"{self.path}: frame {index}"
        try:
            message = _read(self.path, *self.places[index])
            if message.color is None or message.depth is None:
                raise ProtocolError("the frame has no colour or no depth: it can only be sent to a room")
            color = decode_color(message.color, self.camera)
            depth = decode_depth(message.depth, self.camera)
        except (ProtocolError, OSError) as error:
            raise SourceError(f"{where}: {error}") from error
        pose = message.world_from_camera
        matrix = None if pose is None else np.array(pose, np.float64).reshape(4, 4)
        return RgbdFrame(index, message.timestamp_s, color, depth, matrix, message.exposure)


def open_recording(path: Path) -> RecordedSource:
    """Raises SourceError if `path` is no recording, or one without frames."""
    hello, places, stamps = _scan(path)
    if hello is None or not places:
        raise SourceError(f"{path}: holds no captured frames; record with probeless stream SOURCE --record FILE")
    steps = np.diff([time_s for time_s, _ in stamps])
    step_s = median(steps) if len(steps) else 0.0
    fps = 1 / step_s if step_s > 0 else DEFAULT_FPS
    return RecordedSource(path, hello.camera, hello.wishes.up, fps, all(posed for _, posed in stamps), tuple(places))


def _scan(path: Path) -> tuple[Hello | None, list[tuple[int, int]], list[tuple[float, bool]]]:
    """The hello, where the frames lie, and each frame's time and whether it has a pose. Raises SourceError."""
    hello: Hello | None = None
    places: list[tuple[int, int]] = []
    stamps: list[tuple[float, bool]] = []
    with path.open("rb") as file:
        unpacker = msgpack.Unpacker(file, max_buffer_size=MAX_MESSAGE_BYTES)
        start = 0
        try:
            while True:
                message = unpacker.unpack()
                start, length = unpacker.tell(), unpacker.tell() - start
                match message:
                    case {"type": "hello"}:
                        hello = msgspec.convert(message, Hello)
                    case {"type": "frame", "timestamp_s": time_s, "world_from_camera": pose}:
                        places.append((start - length, length))
                        stamps.append((time_s, pose is not None))
                    case {"type": _}:
                        pass
                    case _:
                        raise ValueError("no message")
        except msgpack.OutOfData:
            left_over = path.stat().st_size - start
        except (msgpack.UnpackException, msgspec.ValidationError, ValueError) as error:
            raise SourceError(
                f"{path}: is not a recording (byte {start}); give a data-set folder, a recording or synthetic:table"
            ) from error
    if left_over and start:
        note(f"{path}: ends inside a message; its {left_over} last bytes were left out")
    return hello, places, stamps


def _read(path: Path, start: int, length: int) -> Frame:
    with path.open("rb") as file:
        file.seek(start)
        message = decode_client(file.read(length))
    if not isinstance(message, Frame):
        raise ProtocolError("the file has changed since it was opened")
    return message
