"""Panoramas as files: orientation, and both formats read back by readers that did not write them."""

from __future__ import annotations

import struct
from pathlib import Path

import av
import numpy as np
import pytest
from numpy.typing import NDArray

from protocol.limits import MAX_PANORAMA_BYTES
from server.light.panorama import panorama_sh, read_panorama
from server.light.panorama_file import HEIGHT_PX, WIDTH_PX, encode_panorama, lat_long_radiance
from server.maths.sh import rotate_sh, sh_basis, webxr_from_world
from tests.scenes import lights

Floats = NDArray[np.float64]
UP, VIEW = np.array([0.0, 0.0, 1.0]), np.array([0.6, 0.8, 0.0])
"""With y down, the rotation would be its own inverse and hide a turn the wrong way."""


def random_radiance(height: int = 12, width: int = 24) -> Floats:
    return np.random.default_rng(3).exponential(2.0, (height, width, 3))


def read_exr(data: bytes) -> tuple[dict[str, bytes], NDArray[np.float16]]:
    """Attributes and [h, w, 3] RGB of an uncompressed file, from "OpenEXR File Layout"; each line by its offset."""
    assert struct.unpack_from("<II", data) == (20000630, 2)
    at, attributes = 8, {}
    while data[at]:
        name, kind = data[at:].split(b"\0", 2)[:2]
        at += len(name) + len(kind) + 2
        (size,) = struct.unpack_from("<i", data, at)
        attributes[name.decode()] = data[at + 4 : at + 4 + size]
        at += 4 + size
    left, top, right, bottom = struct.unpack("<4i", attributes["dataWindow"])
    width, height = right - left + 1, bottom - top + 1
    channels = [entry for entry in attributes["channels"].split(b"\0") if entry in (b"R", b"G", b"B")]
    picture = np.zeros((height, width, 3), np.float16)
    for row in range(height):
        (offset,) = struct.unpack_from("<Q", data, at + 1 + 8 * row)
        y, size = struct.unpack_from("<ii", data, offset)
        assert size == 6 * width
        line = np.frombuffer(data, "<f2", 3 * width, offset + 8).reshape(3, width)
        for channel, values in zip(channels, line, strict=True):
            picture[y - top, :, b"RGB".index(channel)] = values
    assert offset + 8 + size == len(data)
    return attributes, picture


def test_ffmpeg_reads_the_same_exr(tmp_path: Path) -> None:
    radiance = random_radiance()
    (tmp_path / "a.exr").write_bytes(encode_panorama(radiance, "exr"))
    with av.open(str(tmp_path / "a.exr")) as container:
        found = next(container.decode(video=0))
    assert found.format.name == "gbrpf16le"
    planes = [np.frombuffer(plane, np.float16).reshape(12, -1)[:, :24] for plane in found.planes]
    np.testing.assert_array_equal(np.stack([planes[2], planes[0], planes[1]], -1), radiance.astype(np.float16))


def test_exr_is_read_back_to_half_precision() -> None:
    radiance = random_radiance()
    attributes, picture = read_exr(encode_panorama(radiance, "exr"))
    np.testing.assert_array_equal(picture, radiance.astype(np.float16))
    assert attributes["compression"] == b"\0"
    assert attributes["displayWindow"] == attributes["dataWindow"] == struct.pack("<4i", 0, 0, 23, 11)
    assert {"lineOrder", "pixelAspectRatio", "screenWindowCenter", "screenWindowWidth"} < attributes.keys()


def test_exr_holds_no_infinity() -> None:
    _, picture = read_exr(encode_panorama(np.full((2, 4, 3), 1e9), "exr"))
    assert (picture == np.float16(65504)).all()


def test_hdr_is_read_back_by_opencv(tmp_path: Path) -> None:
    radiance = random_radiance()
    path = tmp_path / "sky.hdr"
    path.write_bytes(encode_panorama(radiance, "hdr"))
    step = radiance.max(axis=2, keepdims=True) / 128  # RGBE: 8 bits below the power of two above the brightest
    assert (np.abs(read_panorama(path) - radiance) <= step).all()


@pytest.mark.parametrize("format_", ["hdr", "exr"])
def test_equal_radiance_gives_equal_bytes_that_fit_a_message(format_: str) -> None:
    radiance = np.random.default_rng(1).exponential(size=(HEIGHT_PX, WIDTH_PX, 3))  # noise: nothing to compress
    data = encode_panorama(radiance, format_)  # type: ignore[arg-type]
    assert data == encode_panorama(radiance, format_)  # type: ignore[arg-type]
    assert len(data) <= MAX_PANORAMA_BYTES


def test_rows_and_columns() -> None:
    """Up is bright in red, the first view in green, its right in blue: red at the top, green in the middle column."""
    axes = webxr_from_world(UP, VIEW)
    right = np.cross(VIEW, UP)
    picture = lat_long_radiance(lambda d: np.maximum(d @ np.stack([UP, VIEW, right]).T, 0), axes)
    assert picture.shape == (HEIGHT_PX, WIDTH_PX, 3)
    (top, _), (row, column), (_, beside) = (
        np.unravel_index(picture[..., channel].argmax(), picture.shape[:2]) for channel in range(3)
    )
    assert top == 0
    assert abs(row - HEIGHT_PX / 2) <= 1
    assert abs(column - WIDTH_PX / 2) <= 1
    assert abs(beside - 3 * WIDTH_PX / 4) <= 1


def test_a_light_survives_the_way_through_a_file(tmp_path: Path) -> None:
    """Written here, read by `--panorama`: the same 16 coefficients in WebXR's axes."""
    light, axes = lights.lobe_and_sky((0.3, -0.8, 0.2)), webxr_from_world(UP, VIEW)
    picture = lat_long_radiance(lambda d: sh_basis(d, 4) @ light, axes)
    path = tmp_path / "sky.hdr"
    path.write_bytes(encode_panorama(picture, "hdr"))
    found = panorama_sh(read_panorama(path), 4)
    np.testing.assert_allclose(found, rotate_sh(light, axes), atol=0.004 * np.abs(light).max())  # RGBE: 1/256
