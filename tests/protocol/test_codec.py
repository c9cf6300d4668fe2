"""Bytes and messages: round trips, an independent MessagePack library, and everything hostile."""

from __future__ import annotations

import math

import msgpack
import msgspec
import numpy as np
import pytest

from protocol.codec import ProtocolError, decode_client, decode_server, encode, one_line
from protocol.limits import MAX_IMAGE_PIXELS, MAX_MESH_BYTES, MAX_MESSAGE_BYTES, MAX_REASON_CHARS
from protocol.messages import Bye, ClientMessage, ColorImage, Frame, ServerMessage
from tests.protocol.samples import CLIENT, SERVER, random_frame, random_light


def _fields(message: object) -> dict[str, object]:
    """What any MessagePack reader sees of a message: plain containers, lists for tuples."""
    return msgspec.to_builtins(message, builtin_types=(bytes,))


def _as_lists(value: object) -> object:
    if isinstance(value, dict):
        return {key: _as_lists(item) for key, item in value.items()}
    return [_as_lists(item) for item in value] if isinstance(value, list | tuple) else value


@pytest.mark.parametrize("name", CLIENT)
def test_every_client_message_survives_the_wire(name: str) -> None:
    assert decode_client(encode(CLIENT[name])) == CLIENT[name]


@pytest.mark.parametrize("name", SERVER)
def test_every_server_message_survives_the_wire(name: str) -> None:
    assert decode_server(encode(SERVER[name])) == SERVER[name]


def test_samples_cover_both_unions() -> None:
    assert {type(message) for message in CLIENT.values()} == set(ClientMessage.__args__)
    assert {type(message) for message in SERVER.values()} == set(ServerMessage.__args__)


@pytest.mark.parametrize("seed", range(50))
def test_random_messages_survive_bit_for_bit(seed: int) -> None:
    random = np.random.default_rng(seed)
    frame, light = random_frame(random), random_light(random)
    assert decode_client(encode(frame)) == frame
    assert decode_client(memoryview(bytearray(encode(frame)))) == frame
    assert decode_server(encode(light)) == light


@pytest.mark.parametrize("name", [*CLIENT, *SERVER])
def test_msgpack_reads_what_we_write(name: str) -> None:
    message = {**CLIENT, **SERVER}[name]
    assert msgpack.unpackb(encode(message)) == _as_lists(_fields(message))


@pytest.mark.parametrize("name", [*CLIENT, *SERVER])
def test_we_read_what_msgpack_writes(name: str) -> None:
    message = {**CLIENT, **SERVER}[name]
    decode = decode_client if name in CLIENT else decode_server
    assert decode(msgpack.packb(_fields(message))) == message


@pytest.mark.parametrize("seed", range(20))
def test_random_frames_agree_with_msgpack(seed: int) -> None:
    frame = random_frame(np.random.default_rng(1000 + seed))
    assert msgpack.unpackb(encode(frame)) == _as_lists(_fields(frame))
    assert decode_client(msgpack.packb(_fields(frame))) == frame


def test_left_out_defaults_and_whole_numbers_for_floats_are_accepted() -> None:
    camera = {"width": 64, "height": 48, "fx": 50, "fy": 50, "cx": 31, "cy": 23}
    hello = decode_client(msgpack.packb({"type": "hello", "client": "js", "camera": camera}))
    assert hello.camera.depth_scale_m == 0.001
    assert isinstance(hello.camera.fx, float)


def _frame_fields() -> dict[str, object]:
    return _fields(CLIENT["frame"])


def _with(path: str, value: object) -> bytes:
    """The sample frame or hello with one field replaced (`depth.width`), or added."""
    name, *keys, last = path.split(".")
    fields = _fields(CLIENT[name])
    inner = fields
    for key in keys:
        inner = inner[key]
    inner[last] = value
    return msgpack.packb(fields)


@pytest.mark.parametrize(
    ("path", "value", "named"),
    [
        ("frame.depth.width", 0, "$.depth.width"),
        ("frame.depth.width", "640", "$.depth.width"),
        ("frame.depth.height", 5000, "$.depth.height"),
        ("frame.depth.codec", "rvl", "$.depth.codec"),
        ("frame.color.data", "text", "$.color.data"),
        ("frame.color.encoding", "adobe", "$.color.encoding"),
        ("frame.world_from_camera", [1.0] * 15, "$.world_from_camera"),
        ("frame.world_from_camera", [*[0.0] * 15, math.nan], "frame.world_from_camera"),
        ("frame.world_from_camera", [*[0.0] * 15, "x"], "$.world_from_camera[15]"),
        ("frame.timestamp_s", math.inf, "frame.timestamp_s"),
        ("frame.timestamp_s", None, "$.timestamp_s"),
        ("frame.frame", -1, "$.frame"),
        ("frame.frame", 2**63, "$.frame"),
        ("frame.extra", 1, "extra"),
        ("frame.depth.extra", 1, "extra"),
        ("frame.type", "fream", "$.type"),
        ("hello.client", "x" * 65, "$.client"),
        ("hello.client", "", "$.client"),
        ("hello.camera.fx", math.nan, "camera.fx"),
        ("hello.camera.width", 2**63, "camera.width"),
        ("hello.camera.distortion", [0.0] * 4, "$.camera.distortion"),
        ("hello.wishes.preset", "best", "$.wishes.preset"),
        ("hello.wishes.up", [0.0, 0.0, 0.0], "wishes.up"),
        ("place_object.data", bytes(MAX_MESH_BYTES + 1), "$.data"),
        ("place_object.position_m", [0.0, -math.inf, 0.0], "place_object.position_m"),
        ("move_object.scale", 0, "$.scale"),
        ("quality.preset", 3, "$.preset"),
    ],
)
def test_a_wrong_field_is_named(path: str, value: object, named: str) -> None:
    with pytest.raises(ProtocolError) as refusal:
        decode_client(_with(path, value))
    assert named in str(refusal.value)
    assert "\n" not in str(refusal.value)


@pytest.mark.parametrize("field", ["type", "frame", "timestamp_s", "world_from_camera"])
def test_a_missing_field_is_named(field: str) -> None:
    fields = _frame_fields()
    del fields[field]
    with pytest.raises(ProtocolError, match=f"`{field}`"):
        decode_client(msgpack.packb(fields))


def test_declared_pictures_larger_than_the_limit_are_refused() -> None:
    with pytest.raises(ProtocolError, match=f"{MAX_IMAGE_PIXELS} pixels"):
        decode_client(_with("frame.depth", {"width": 4096, "height": 4096, "codec": "raw", "data": b""}))


HOSTILE = {
    "empty": b"",
    "never used code": b"\xc1",
    "no map": msgpack.packb([1, 2]),
    "a number": b"\x07",
    "text": b"GET / HTTP/1.1\r\n",
    "4 GB of bytes": b"\x81\xa4data\xc6\xff\xff\xff\xff",
    "4 G array elements": b"\xdd\xff\xff\xff\xff",
    "4 G map entries": b"\xdf\xff\xff\xff\xff",
    "4 GB tag": b"\x81\xa4type\xdb\xff\xff\xff\xff",
    "deep nesting": b"\x91" * 100_000,
    "deep nesting in a field": b"\x82\xa4type\xa3bye\xa6reason" + b"\x91" * 100_000,
    "not UTF-8": b"\x82\xa4type\xa3bye\xa6reason\xa2\xff\xfe",
    "number as key": msgpack.packb({1: 2}),
    "extension type": b"\x82\xa4type\xa3bye\xa6reason\xd4\x05\x00",
    "trailing byte": encode(CLIENT["frame"]) + b"\x00",
    "two messages": encode(Bye()) * 2,
    "a server's message": encode(SERVER["welcome"]),
    "line breaks in a key": msgpack.packb({"type": "bye", "a\r\n\x1b[31mb": 1}),
    "line breaks in the tag": msgpack.packb({"type": "bye\nbye" * 1000}),
}


@pytest.mark.parametrize("name", HOSTILE)
def test_hostile_bytes_are_refused_in_one_short_line(name: str) -> None:
    with pytest.raises(ProtocolError) as refusal:
        decode_client(HOSTILE[name])
    text = str(refusal.value)
    assert text.isprintable()
    assert len(text) <= MAX_REASON_CHARS


@pytest.mark.parametrize("name", [*CLIENT, *SERVER])
def test_every_truncation_is_refused(name: str) -> None:
    data = encode({**CLIENT, **SERVER}[name])
    decode = decode_client if name in CLIENT else decode_server
    for length in range(len(data)):
        with pytest.raises(ProtocolError):
            decode(data[:length])


def test_random_bytes_never_raise_anything_else() -> None:
    random = np.random.default_rng(3)
    valid = encode(CLIENT["frame"])
    for _ in range(3000):
        damaged = bytearray(valid)
        for at in random.integers(0, len(valid), random.integers(1, 6)):
            damaged[at] = random.integers(0, 256)
        try:
            message = decode_client(bytes(damaged))
        except ProtocolError:
            continue
        assert isinstance(message, Frame)


def test_size_is_checked_before_decoding() -> None:
    with pytest.raises(ProtocolError, match=f"{MAX_MESSAGE_BYTES + 1} bytes exceeds the limit"):
        decode_client(b"\xc1" * (MAX_MESSAGE_BYTES + 1))
    wide = memoryview(np.zeros(MAX_MESSAGE_BYTES // 4, np.uint64))
    with pytest.raises(ProtocolError, match="exceeds the limit"):
        decode_client(wide)


def test_a_message_that_would_be_refused_is_not_encoded() -> None:
    color = ColorImage(width=1, height=1, codec="raw", data=bytes(MAX_MESSAGE_BYTES))
    with pytest.raises(ProtocolError, match="exceeds the limit"):
        encode(msgspec.structs.replace(CLIENT["frame"], color=color))


def test_the_error_is_a_value_error_that_fits_an_error_message() -> None:
    assert issubclass(ProtocolError, ValueError)
    assert one_line("a\n\t b\x00c") == "a b c"
    assert len(one_line("x" * 10_000)) == MAX_REASON_CHARS


def test_colour_is_missing_only_where_somebody_looks_from_a_pose() -> None:
    fields = _frame_fields()
    del fields["depth"]
    assert decode_client(msgpack.packb(fields)).depth is None
    del fields["color"]
    assert decode_client(msgpack.packb(fields)).color is None
    for wrong in ({"depth": _frame_fields()["depth"]}, {"world_from_camera": None}):
        with pytest.raises(ProtocolError, match=r"frame\.color may be left out only"):
            decode_client(msgpack.packb(fields | wrong))
