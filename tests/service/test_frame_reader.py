"""A frame's depth is decoded while its colours are; what is damaged is told, and the next frame is read."""

from __future__ import annotations

import threading
from collections.abc import Iterator

import numpy as np
import pytest
from msgspec import structs
from numpy.typing import NDArray

from protocol.codec import ProtocolError
from protocol.colors import ColorReader
from protocol.frames import CameraModel, RgbdFrame, Viewpoint
from protocol.images import decode_depth, decode_picture, encode_color, encode_depth
from protocol.messages import DepthImage, Frame
from server.service import frame_reader
from server.service.frame_reader import FrameReader

LENS = CameraModel(width=32, height=24, fx=30.0, fy=30.0, cx=15.5, cy=11.5)
POSE = tuple(float(x) for x in np.eye(4).ravel())
COLOR = np.random.default_rng(1).integers(0, 256, (24, 32, 3), np.uint8)
DEPTH = np.random.default_rng(2).integers(0, 4000, (24, 32), np.uint16)
MESSAGE = Frame(
    frame=3,
    timestamp_s=0.1,
    world_from_camera=POSE,
    color=encode_color(COLOR, "png"),
    depth=encode_depth(DEPTH, "zstd-ranks"),
)


@pytest.fixture
def reader() -> Iterator[FrameReader]:
    reader = FrameReader(LENS, ColorReader(LENS))
    yield reader
    reader.close()


def test_a_frame_is_what_was_sent(reader: FrameReader) -> None:
    read = reader.read(MESSAGE)
    assert isinstance(read, RgbdFrame)
    assert (read.index, read.timestamp_s, read.has_depth) == (3, 0.1, True)
    np.testing.assert_array_equal(read.color, COLOR)
    np.testing.assert_array_equal(read.depth, DEPTH)
    assert read.world_from_camera is not None
    np.testing.assert_array_equal(read.world_from_camera, np.eye(4))
    assert reader.take_cpu_s() > 0
    assert reader.take_cpu_s() == 0


def test_without_depth_or_pictures(reader: FrameReader) -> None:
    read = reader.read(structs.replace(MESSAGE, depth=None))
    assert isinstance(read, RgbdFrame)
    assert not read.has_depth
    assert read.depth.shape == (24, 32)
    assert not read.depth.any()
    assert isinstance(reader.read(structs.replace(MESSAGE, color=None, depth=None)), Viewpoint)


def test_depth_does_not_wait_for_the_colours(monkeypatch: pytest.MonkeyPatch) -> None:
    """Nor they for it: each ends only once the other has begun."""
    begun = {"color": threading.Event(), "depth": threading.Event()}

    def meet(own: str, other: str) -> None:
        begun[own].set()
        assert begun[other].wait(10.0)

    def color(data: bytes) -> NDArray[np.uint8]:
        meet("color", "depth")
        return decode_picture(data)

    def depth(image: DepthImage, camera: CameraModel) -> NDArray[np.uint16]:
        meet("depth", "color")
        return decode_depth(image, camera)

    monkeypatch.setattr(frame_reader, "decode_depth", depth)
    reader = FrameReader(LENS, ColorReader(LENS, color))
    read = reader.read(MESSAGE)
    reader.close()
    assert isinstance(read, RgbdFrame)
    np.testing.assert_array_equal(read.color, COLOR)
    np.testing.assert_array_equal(read.depth, DEPTH)


@pytest.mark.parametrize("field", ["color", "depth"])
def test_what_is_damaged_is_told_and_the_next_frame_is_read(reader: FrameReader, field: str) -> None:
    image = getattr(MESSAGE, field)
    damaged = structs.replace(MESSAGE, **{field: structs.replace(image, data=image.data[: len(image.data) // 2])})
    with pytest.raises(ProtocolError, match=field):
        reader.read(damaged)
    read = reader.read(MESSAGE)
    assert isinstance(read, RgbdFrame)
    np.testing.assert_array_equal(read.color, COLOR)
    np.testing.assert_array_equal(read.depth, DEPTH)


def test_what_was_begun_is_read_once_and_in_order() -> None:
    """Also what is never asked for; only one frame is begun at a time, and none once the reader is closed."""
    read: list[bytes] = []
    others = [structs.replace(MESSAGE, color=encode_color(COLOR + step, "png")) for step in range(1, 4)]

    def color(data: bytes) -> NDArray[np.uint8]:
        read.append(data)
        return decode_picture(data)

    reader = FrameReader(LENS, ColorReader(LENS, color))
    reader.begin(others[0])
    reader.begin(others[1])
    for asked, shown in ((others[0], COLOR + 1), (others[2], COLOR + 3)):
        found = reader.read(asked)
        assert isinstance(found, RgbdFrame)
        np.testing.assert_array_equal(found.color, shown)
    reader.begin(others[1])
    np.testing.assert_array_equal(reader.read(MESSAGE).color, COLOR)  # type: ignore[union-attr]
    reader.close()
    reader.begin(others[0])
    data = [message.color.data for message in (others[0], others[2], others[1], MESSAGE) if message.color]
    assert read == data


def test_damage_is_told_to_who_asks_for_what_was_begun(reader: FrameReader) -> None:
    assert MESSAGE.color is not None
    damaged = structs.replace(MESSAGE, color=structs.replace(MESSAGE.color, data=MESSAGE.color.data[:50]))
    reader.begin(damaged)
    assert isinstance(reader.read(MESSAGE), RgbdFrame)  # nobody asked for the other
    reader.begin(damaged)
    with pytest.raises(ProtocolError, match="color"):
        reader.read(damaged)
