"""H.264 as it says what it is: made by hand, bit by bit, and by an encoder; refused before a decoder sees it."""

from __future__ import annotations

import contextlib
import random
import time

import numpy as np
import pytest

from client.streaming.video import VideoEncoder
from protocol.codec import ProtocolError
from protocol.h264 import MISSING, Sequence, VideoOrder, is_key_picture, sequence_of, units_of

START = b"\x00\x00\x00\x01"
SIZE = (64, 48)
PICTURE_SET = b"\x68\xce\x38\x80"


def ue(value: int) -> str:
    """Exp-Golomb (9.1)."""
    bits = bin(value + 1)[2:]
    return "0" * (len(bits) - 1) + bits


def unit(header: int, bits: str) -> bytes:
    """A NAL unit with its stop bit and emulation prevention (7.4.1)."""
    bits += "1"
    bits += "0" * (-len(bits) % 8)
    payload = bytes(int(bits[at : at + 8], 2) for at in range(0, len(bits), 8))
    escaped, zeros = bytearray(), 0
    for byte in payload:
        if zeros == 2 and byte <= 3:
            escaped.append(3)
            zeros = 0
        escaped.append(byte)
        zeros = zeros + 1 if byte == 0 else 0
    return bytes([header]) + bytes(escaped)


def parameters(width: int = 64, height: int = 48, **changed: object) -> bytes:
    """A sequence parameter set (7.3.2.1.1) of this size."""
    said = {"profile": 66, "chroma": 1, "depth": 0, "scaling": "0", "order": 2, "progressive": "1", "numbers": 0}
    said |= changed
    across, down = -(-width // 16), -(-height // 16)
    bits = f"{said['profile']:08b}" + "0" * 8 + f"{30:08b}" + ue(0)
    if said["profile"] == 100:
        bits += ue(said["chroma"]) + ue(said["depth"]) + ue(said["depth"]) + "0" + said["scaling"]
    bits += ue(said["numbers"]) + ue(said["order"])
    if said["order"] == 0:
        bits += ue(4)
    if said["order"] == 1:
        bits += "0" + ue(0) + ue(0) + ue(2) + ue(7) + ue(9)
    bits += ue(1) + "0" + ue(across - 1) + ue(down - 1) + said["progressive"] + "1"
    cut = (16 * across - width) // 2, (16 * down - height) // 2
    bits += "1" + ue(0) + ue(cut[0]) + ue(0) + ue(cut[1]) if any(cut) else "0"
    return unit(0x67, bits + "0")


def piece(
    number: int, key: bool = False, first: int = 0, kind: int = 5, bits: int = 4, reference: bool = True
) -> bytes:
    """The beginning of a slice (7.3.3)."""
    header = (0x60 if reference else 0) | (5 if key else 1)
    return unit(header, ue(first) + ue(7 if key else kind) + ue(0) + f"{number:0{bits}b}" + "1" * 40)


def picture(*units: bytes) -> bytes:
    return b"".join(START + one for one in units)


KEY = picture(parameters(), PICTURE_SET, piece(0, key=True))


def after_key() -> VideoOrder:
    order = VideoOrder()
    assert order.admit(KEY, *SIZE)
    return order


@pytest.mark.parametrize("size", [(64, 48), (640, 480), (1280, 720), (1920, 1080), (62, 34)])
@pytest.mark.parametrize("said", [{}, {"profile": 77, "order": 0}, {"profile": 100, "order": 1, "numbers": 4}])
def test_a_sequences_size_is_read(size: tuple[int, int], said: dict) -> None:
    assert sequence_of(parameters(*size, **said)) == Sequence(*size, 1 << (4 + said.get("numbers", 0)))


def test_pictures_follow_one_another_and_their_numbers_begin_anew() -> None:
    order = after_key()
    for number in [*range(1, 16), *range(16), 0]:
        assert not order.admit(picture(piece(number)), *SIZE)
    assert order.admit(KEY, *SIZE)
    assert not order.admit(picture(piece(1)), *SIZE)


def test_a_picture_that_nothing_rests_on_may_be_missing() -> None:
    order = after_key()
    order.admit(picture(piece(1, reference=False)), *SIZE)
    order.admit(picture(piece(1)), *SIZE)
    order.admit(picture(piece(2)), *SIZE)


@pytest.mark.parametrize("number", [0, 1, 3, 15])
def test_a_missing_picture_is_found_and_only_a_key_picture_helps(number: int) -> None:
    order = after_key()
    order.admit(picture(piece(1)), *SIZE)
    for _ in range(2):
        with pytest.raises(ProtocolError, match=MISSING):
            order.admit(picture(piece(number)), *SIZE)
        number = 2
    assert order.admit(KEY, *SIZE)
    order.admit(picture(piece(1)), *SIZE)


def test_nothing_comes_before_a_key_picture_nor_after_what_was_refused() -> None:
    with pytest.raises(ProtocolError, match=MISSING):
        VideoOrder().admit(picture(piece(1)), *SIZE)
    order = after_key()
    with pytest.raises(ProtocolError, match=r"not H\.264"):
        order.admit(b"", *SIZE)
    with pytest.raises(ProtocolError, match=MISSING):
        order.admit(picture(piece(1)), *SIZE)
    order.admit(KEY, *SIZE)
    order.begin_anew()
    with pytest.raises(ProtocolError, match=MISSING):
        order.admit(picture(piece(1)), *SIZE)


def test_a_picture_may_be_of_several_slices() -> None:
    parts = [piece(0, key=True), piece(0, key=True, first=4), piece(0, key=True, first=8)]
    order = VideoOrder()
    assert order.admit(picture(b"\x09\x10", parameters(), PICTURE_SET, b"\x06\x05\x01\x00\x80", *parts), *SIZE)


BAD = {
    "nothing": (b"", "Annex B"),
    "no start code": (KEY[4:], "Annex B"),
    "text before it": (b"hello" + KEY, "Annex B"),
    "an empty unit": (START + START + KEY, "empty NAL unit"),
    "ends in a start code": (KEY + START, "empty NAL unit"),
    "too many units": (KEY + picture(*[b"\x0c\xff"] * 64), "more than 64 NAL units"),
    "data partitioning": (KEY + picture(b"\x62\x80"), "type 2"),
    "scalable": (picture(b"\x6e\x80") + KEY, "type 14"),
    "a key picture alone": (picture(piece(0, key=True)), "without its one sequence"),
    "two sequences": (picture(parameters()) + KEY, "without its one sequence"),
    "no picture parameters": (picture(parameters(), piece(0, key=True)), "without its one sequence"),
    "parameters without a picture": (picture(parameters(), PICTURE_SET), "between key pictures"),
    "two pictures": (KEY + picture(piece(0, key=True)), "exactly one picture"),
    "two numbers": (KEY + picture(piece(1, key=True, first=4)), "exactly one picture"),
    "its end alone": (picture(parameters(), PICTURE_SET, piece(0, key=True, first=4)), "exactly one picture"),
    "a key picture and another": (KEY + picture(piece(0, first=4)), "slices of several pictures"),
    "a key picture that goes on": (picture(parameters(), PICTURE_SET, piece(3, key=True)), MISSING),
    "another size": (picture(parameters(64, 64), PICTURE_SET, piece(0, key=True)), "video of 64x64"),
    "huge": (picture(parameters(16000, 16000), PICTURE_SET, piece(0, key=True)), "video of 16000x16000"),
    "a side beyond all": (picture(parameters(1 << 18, 48), PICTURE_SET, piece(0, key=True)), "at most 1024 may be"),
    "interlaced": (picture(parameters(progressive="0"), PICTURE_SET, piece(0, key=True)), "interlaced"),
    "of ten bits": (picture(parameters(profile=100, depth=2), PICTURE_SET, piece(0, key=True)), "4:2:0 of 8 bits"),
    "4:2:2": (picture(parameters(profile=100, chroma=2), PICTURE_SET, piece(0, key=True)), "4:2:0 of 8 bits"),
    "scaling lists": (picture(parameters(profile=100, scaling="1"), PICTURE_SET, piece(0, key=True)), "flat scaling"),
    "another profile": (picture(parameters(profile=110), PICTURE_SET, piece(0, key=True)), "profile 110"),
    "a header cut off": (picture(parameters()[:6], PICTURE_SET, piece(0, key=True)), "truncated"),
    "zeros": (
        picture(b"\x67" + b"\x42\x00\x1e" + b"\x00\x00\x03" * 20 + b"\x01", PICTURE_SET, piece(0, key=True)),
        "H.264",
    ),
}


@pytest.mark.parametrize("name", BAD)
def test_what_is_no_plain_picture_is_refused(name: str) -> None:
    data, words = BAD[name]
    with pytest.raises(ProtocolError, match=r"color\.data") as refusal:
        VideoOrder().admit(data, *SIZE)
    assert words in str(refusal.value), refusal.value


@pytest.mark.parametrize("kind", [1, 3, 4, 6, 8, 9])
def test_pictures_between_others_and_switching_ones_are_refused(kind: int) -> None:
    with pytest.raises(ProtocolError, match="B or switching"):
        after_key().admit(picture(piece(1, kind=kind)), *SIZE)


def test_new_parameters_between_key_pictures_are_refused() -> None:
    with pytest.raises(ProtocolError, match="between key pictures"):
        after_key().admit(picture(parameters(), piece(1)), *SIZE)


def test_mutated_headers_are_refused_or_of_the_declared_size() -> None:
    chance = random.Random(3)
    for _ in range(3000):
        data = bytearray(KEY)
        for _ in range(chance.randrange(1, 4)):
            data[chance.randrange(len(data))] = chance.randrange(256)
        order = VideoOrder()
        with contextlib.suppress(ProtocolError):
            order.admit(bytes(data), *SIZE)
            assert order._sequence is not None
            assert (order._sequence.width, order._sequence.height) == SIZE


def test_a_large_message_takes_no_longer_than_to_read_it() -> None:
    hostile = [
        KEY + bytes(8 << 20),
        picture(parameters() + b"\xff" * (8 << 20)),
        START + b"\x00\x00\x01\x65" * (2 << 20),
    ]
    began_s = time.perf_counter()
    for data in hostile:
        with contextlib.suppress(ProtocolError):
            VideoOrder().admit(data, *SIZE)
    assert time.perf_counter() - began_s < 2.0


def test_an_encoders_stream_is_admitted() -> None:
    pytest.importorskip("av")
    video, order = VideoEncoder(), VideoOrder()
    for number in range(40):
        if number == 30:
            video.need_key()
        rgb = np.random.default_rng(number).integers(0, 255, (48, 64, 3), np.uint8)
        data = video.encode(rgb, 75).data
        assert order.admit(data, *SIZE) == is_key_picture(data) == (number in (0, 30))
        assert all(units_of(data))
