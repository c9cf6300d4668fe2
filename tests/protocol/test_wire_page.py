"""The wire page shows the bytes and fields of the messages that there are now."""

from __future__ import annotations

import re

import msgpack
import msgspec
import pytest

from protocol.byte_listing import listing, read_listing
from protocol.codec import ProtocolError, decode_client
from protocol.messages import ClientMessage, Frame, Hello, ServerMessage
from protocol.typescript import field_docs, structs_of
from protocol.wire_page import EXAMPLE_FRAME, EXAMPLE_HELLO, FIELDS, PAGE, fields_page, page
from server.service.serve import BackgroundServer
from server.service.service import Service
from tests.service.wire import Wire

PAGE_TEXT = PAGE.read_text(encoding="utf-8")


def _bytes_on_the_page() -> list[bytes]:
    return [read_listing(block) for block in re.findall(r"bytes:\n\n```text\n(.*?)```", PAGE_TEXT, re.DOTALL)]


def test_the_pages_are_current() -> None:
    assert page(PAGE_TEXT) == PAGE_TEXT, "stale: run `python -m protocol.wire_page`"
    assert FIELDS.read_text(encoding="utf-8") == fields_page(), "stale: run `python -m protocol.wire_page`"


def test_the_bytes_on_the_page_are_the_messages_that_it_says() -> None:
    hello, frame = _bytes_on_the_page()
    assert msgpack.unpackb(hello) == EXAMPLE_HELLO  # an independent reader
    assert msgpack.unpackb(frame) == EXAMPLE_FRAME
    assert isinstance(decode_client(hello), Hello)
    assert isinstance(decode_client(frame), Frame)


def test_meanings_beside_the_bytes_are_their_values() -> None:
    text = listing(msgpack.packb({"a": -0.5, "b": [1, 300], "c": None, "d": {"e": b"\1\2"}, "f": True}))
    meanings = [line.split("# ")[1] for line in text.splitlines()]
    assert meanings == [
        "map of 5 fields", '"a": -0.5', '"b": [1, 300]', '"c": null', '"d": map of 1 fields',
        '"e": 2 bytes', '"f": true',
    ]  # fmt: skip
    with pytest.raises(ValueError, match="follow the message"):
        listing(msgpack.packb(1) + b"\0")


def test_a_server_answers_the_bytes_on_the_page(device) -> None:
    with BackgroundServer(Service(device)) as server:
        wire = Wire(server.url)
        for data in _bytes_on_the_page():
            wire.socket.send(data)
        kinds = [msgpack.unpackb(wire.socket.recv(timeout=120))["type"] for _ in range(3)]
        wire.hang_up()
    assert kinds == ["welcome", "light", "composite"]


def test_every_field_has_a_meaning() -> None:
    classes = structs_of((*ClientMessage.__args__, *ServerMessage.__args__))
    bare = [
        f"{cls.__name__}.{field.name}"
        for cls in classes
        for field in msgspec.structs.fields(cls)
        if not field_docs(cls).get(field.name)
    ]
    assert bare == []


def _hello(**camera: object) -> dict[str, object]:
    return {**EXAMPLE_HELLO, "camera": {**EXAMPLE_HELLO["camera"], **camera}}


def _refusal(message: dict[str, object]) -> str:
    with pytest.raises(ProtocolError) as refused:
        decode_client(msgpack.packb(message))
    return str(refused.value)


def test_all_missing_fields_are_told_at_once() -> None:
    camera = {"width": 16, "fx": 16.0, "fy": 16.0}
    reason = _refusal({"type": "hello", "camera": camera})
    for name in ("$.client", "$.camera.height", "$.camera.cx", "$.camera.cy"):
        assert name in reason
    assert "$.camera.fx" not in reason
    frame = {"type": "frame", "color": {"width": 1}}
    for name in ("$.frame,", "$.timestamp_s", "$.world_from_camera", "$.color.height", "$.color.codec", "$.color.data"):
        assert name in _refusal(frame)


@pytest.mark.parametrize("distortion", [[-100.0, 100.0, 0, 0, -100.0], [0, 0, 100.0, 100.0, 0], [100.0, 0, 0, 0, 0]])
def test_a_distortion_that_leaves_no_picture_is_refused(distortion) -> None:
    assert "camera.distortion leaves" in _refusal(_hello(distortion=distortion, fx=8.0, fy=8.0))


def test_strong_lenses_of_real_cameras_are_taken() -> None:
    cameras = [  # published calibrations: Kinect's colour lens, EuRoC's wide lens, a barrel lens of 90 degrees
        {"width": 640, "height": 480, "fx": 517.3, "fy": 516.5, "cx": 318.6, "cy": 255.3,
         "distortion": [0.2624, -0.9531, -0.0054, 0.0026, 1.1633]},
        {"width": 752, "height": 480, "fx": 458.654, "fy": 457.296, "cx": 367.215, "cy": 248.375,
         "distortion": [-0.28340811, 0.07395907, 0.00019359, 1.76187114e-05, 0.0]},
        {"width": 640, "height": 480, "fx": 320.0, "fy": 320.0, "cx": 319.5, "cy": 239.5,
         "distortion": [-0.35, 0.15, 0.0, 0.0, -0.03]},
    ]  # fmt: skip
    for camera in cameras:
        decode_client(msgpack.packb({**EXAMPLE_HELLO, "camera": camera}))


EXTREMES = [1e-45, 1e-37, 1e30, 3.4e38, 1e300]


@pytest.mark.parametrize("value", EXTREMES)
@pytest.mark.parametrize(
    ("field", "make"),
    [
        ("up", lambda value: [value, 0.0, 0.0]),
        ("volume_m", lambda value: [0.0, 0.0, 0.0, value, 1.0, 1.0]),
        ("voxel_m", lambda value: value),
    ],
)
def test_wishes_beyond_what_is_physical_are_refused_by_name(field: str, make, value: float) -> None:
    assert field in _refusal({**EXAMPLE_HELLO, "wishes": {field: make(value)}})


@pytest.mark.parametrize("value", [1e30, 3.4e38, -1e300])
def test_far_places_and_bright_lights_are_refused_by_name(value: float) -> None:
    place = {"type": "place_object", "request": 1, "object": "a", "format": "obj", "data": b""}
    assert "light_at" in _refusal({**EXAMPLE_HELLO, "wishes": {"light_at": [[0, value, 0]]}})
    assert "wishes.light" in _refusal({**EXAMPLE_HELLO, "wishes": {"light": [[value, 0, 0]]}})
    assert "position_m" in _refusal({**place, "position_m": [0, 0, value]})
    assert "yaw_deg" in _refusal({**place, "yaw_deg": value})
    spot = {"on": "ray", "origin_m": [0, 0, 0], "direction": [value, 0, 0]}
    assert "spot.direction" in _refusal({**place, "spot": spot})
    assert "timestamp_s" in _refusal({**EXAMPLE_FRAME, "timestamp_s": value})
