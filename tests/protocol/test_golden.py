"""The wire format does not change unnoticed."""

from __future__ import annotations

import numpy as np
import pytest
from msgspec import structs

from protocol.codec import decode_client, decode_server, encode
from protocol.depth_codec import filter_depth, inflate, unfilter_depth
from protocol.messages import Hello
from tests.protocol.golden import EARLIER, EXPECTED, FOLDER, depth_ramp, messages, render_expected
from tests.protocol.samples import CLIENT, SERVER
from tests.scenes.plain_light import PLAIN_LIGHT


@pytest.mark.parametrize("name", [name for name in messages() if name != "frame_zdelta"])
def test_golden_bytes_are_what_is_written_and_read(name: str) -> None:
    data = (FOLDER / f"{name}.msgpack").read_bytes()
    assert encode(messages()[name]) == data
    assert (decode_server if name in SERVER else decode_client)(data) == messages()[name]


def test_golden_depth_is_read_whatever_deflate_this_zlib_writes() -> None:
    frame = decode_client((FOLDER / "frame_zdelta.msgpack").read_bytes())
    planes = inflate(frame.depth.data, 2 * depth_ramp().size)
    assert planes == filter_depth(depth_ramp())
    assert np.array_equal(unfilter_depth(planes, 10, 8), depth_ramp())


def test_the_expected_fields_for_other_languages_are_current() -> None:
    recorded = EXPECTED.read_text(encoding="utf-8")
    without_deflate = [line for line in recorded.splitlines() if "base64" not in line]
    assert without_deflate == [line for line in render_expected().splitlines() if "base64" not in line]


@pytest.mark.parametrize("name", [path.stem for path in sorted(EARLIER.glob("*.msgpack"))])
def test_bytes_of_earlier_clients_and_servers_are_read(name: str) -> None:
    """From before exposure, then places, were said: fields that are missing have their defaults."""
    data, expected = (EARLIER / f"{name}.msgpack").read_bytes(), messages()[name]
    if isinstance(expected, Hello):  # one albedo was the default, which clients write
        expected = structs.replace(expected, wishes=structs.replace(expected.wishes, **PLAIN_LIGHT))
    assert (decode_server if name in SERVER else decode_client)(data) == expected


def test_there_are_earlier_bytes() -> None:
    assert {path.stem for path in EARLIER.glob("*.msgpack")} == {
        "hello",
        "hello_two_lenses",
        "light",
        "light_of_an_exposure",
        "frame",
        "place_object",
    }


def test_a_frame_of_unknown_exposure_is_written_as_it_always_was() -> None:
    assert encode(CLIENT["frame"]) == (EARLIER / "frame.msgpack").read_bytes()


def test_no_stray_vectors() -> None:
    assert {path.stem for path in FOLDER.glob("*.msgpack")} == set(messages())
