"""A recording as a source: the frames that a client sent, in order."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from statistics import median
from typing import Any

import msgpack
import msgspec
import numpy as np

from client.errors import SourceError
from client.progress import note
from client.sources.files import looked_for
from protocol.codec import ProtocolError, decode_client
from protocol.colors import ColorReader
from protocol.frames import CameraModel, RgbdFrame
from protocol.h264 import VideoOrder
from protocol.images import Color, decode_color, decode_depth
from protocol.limits import MAX_MESSAGE_BYTES
from protocol.messages import ColorImage, Frame, Hello

DEFAULT_FPS = 30.0


@dataclass(frozen=True)
class _FramePosition:
    """Position of a frame in the file."""

    start: int
    length: int
    """Length of its message in bytes."""
    first: int
    """First frame to decode for its colour: itself, or the preceding key picture of a video."""


class _Video:
    """Video of a recording. Sequential reading decodes each picture once; a jump starts at the previous key picture."""

    def __init__(self, camera: CameraModel) -> None:
        self._camera = camera
        self._newest: tuple[int, Color] | None = None
        self._reader = ColorReader(camera)

    def color(self, index: int, first: int, message: Callable[[int], Frame]) -> Color:
        """Colour of frame `index`; `message` reads a frame. Raises ProtocolError."""
        newest = -1 if self._newest is None else self._newest[0]
        if not first <= newest <= index:
            self._reader, newest = ColorReader(self._camera), first - 1
        for position in range(newest + 1, index + 1):
            image = message(position).color
            if image is not None and image.codec == "h264":
                self._newest = None
                self._newest = position, self._reader.decode(image)
        assert self._newest is not None
        return self._newest[1]


@dataclass(frozen=True)
class RecordedSource:
    """A recording as a `Source`; frames are read from the file on demand."""

    path: Path
    camera: CameraModel
    up: tuple[float, float, float] | None
    fps: float
    has_poses: bool
    positions: tuple[_FramePosition, ...] = field(repr=False)
    video: _Video = field(repr=False, compare=False)

    @property
    def name(self) -> str:
        return self.path.name

    def __len__(self) -> int:
        return len(self.positions)

    def __getitem__(self, index: int) -> RgbdFrame:
        index = range(len(self))[index]
        where = f"{self.path}: frame {index}"
        try:
            message = self._message(index)
            if message.color is None or message.depth is None:
                raise ProtocolError("the frame has no colour or no depth: it can only be sent to a room")
            color = self._color(index, message.color)
            depth = decode_depth(message.depth, self.camera)
        except (ProtocolError, OSError) as error:
            raise SourceError(f"{where}: {error}") from error
        pose = message.world_from_camera
        matrix = None if pose is None else np.array(pose, np.float64).reshape(4, 4)
        return RgbdFrame(index, message.timestamp_s, color, depth, matrix, message.exposure)

    def _message(self, index: int) -> Frame:
        return _read(self.path, self.positions[index].start, self.positions[index].length)

    def _color(self, index: int, image: ColorImage) -> Color:
        if image.codec == "h264":
            return self.video.color(index, self.positions[index].first, self._message)
        return decode_color(image, self.camera)


def open_recording(path: Path) -> RecordedSource:
    """Raises SourceError if `path` is not a recording or has no frames."""
    hello, positions, stamps = _scan(path)
    if hello is None or not positions:
        raise SourceError(f"{path}: holds no captured frames; record with probeless stream SOURCE --record FILE")
    steps = np.diff([time_s for time_s, _ in stamps])
    step_s = median(steps) if len(steps) else 0.0
    fps = 1 / step_s if step_s > 0 else DEFAULT_FPS
    is_posed, video = all(posed for _, posed in stamps), _Video(hello.camera)
    return RecordedSource(path, hello.camera, hello.wishes.up, fps, is_posed, tuple(positions), video)


def _scan(path: Path) -> tuple[Hello | None, list[_FramePosition], list[tuple[float, bool]]]:
    """The hello, positions of the frames, and (time, has a pose) of each frame. Raises SourceError."""
    hello: Hello | None = None
    positions: list[_FramePosition] = []
    video = _VideoScan()
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
                        first = video.first(message.get("color"), len(positions))
                        if first is not None:
                            positions.append(_FramePosition(start - length, length, first))
                            stamps.append((time_s, pose is not None))
                    case {"type": _}:
                        pass
                    case _:
                        raise ValueError("no message")
        except msgpack.OutOfData:
            left_over = path.stat().st_size - start
        except (msgpack.UnpackException, msgspec.ValidationError, ValueError) as error:
            raise SourceError(
                f"{path}: is not a recording (byte {start}); looked for a file of stream --record; {looked_for()}"
            ) from error
    if left_over and start:
        note(f"{path}: ends inside a message; its {left_over} last bytes were left out")
    if video.unreadable:
        note(f"{path}: {video.unreadable} frames of video rest on pictures that were not sent; they were left out")
    return hello, positions, stamps


class _VideoScan:
    """Finds key pictures; `first` must be called for each frame in order."""

    def __init__(self) -> None:
        self._order = VideoOrder()
        self._key = 0
        self.unreadable = 0

    def first(self, color: Any, number: int) -> int | None:
        """First frame to decode for frame `number`; None: it cannot be decoded."""
        match color:
            case {"codec": "h264", "data": bytes(data), "width": int(width), "height": int(height)}:
                try:
                    if self._order.admit(data, width, height):
                        self._key = number
                except ProtocolError:
                    self.unreadable += 1
                    return None
                return self._key
        return number


def _read(path: Path, start: int, length: int) -> Frame:
    with path.open("rb") as file:
        file.seek(start)
        message = decode_client(file.read(length))
    if not isinstance(message, Frame):
        raise ProtocolError("the file has changed since it was opened")
    return message
