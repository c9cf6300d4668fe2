"""The wire format does not change unnoticed."""

from __future__ import annotations

import numpy as np
import pytest

from protocol.codec import decode_client, decode_server, encode
from protocol.depth_codec import filter_depth, inflate, unfilter_depth
from tests.protocol.golden import EXPECTED, FOLDER, depth_ramp, messages, render_expected
from tests.protocol.samples import SERVER


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


def test_no_stray_vectors() -> None:
    assert {path.stem for path in FOLDER.glob("*.msgpack")} == set(messages())
