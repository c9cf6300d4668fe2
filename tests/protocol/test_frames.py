"""The camera model: its two lenses, and what it refuses in one line."""

from __future__ import annotations

from typing import Any

import msgspec
import numpy as np
import pytest

from protocol.codec import ProtocolError
from protocol.frames import IDENTITY, CameraModel, DepthCamera
from protocol.images import decode_depth, encode_depth
from protocol.messages import Hello
from tests.protocol.samples import CAMERA, TWO_LENSES

LENS = {"width": 64, "height": 48, "fx": 50.0, "fy": 50.5, "cx": 31.5, "cy": 23.5}


def changed(matrix: tuple[float, ...], **at: float) -> tuple[float, ...]:
    """`matrix` with entries replaced: `_3=0.5` is the fourth."""
    return tuple(at.get(f"_{i}", value) for i, value in enumerate(matrix))


def test_one_lens_is_both() -> None:
    assert CAMERA.depth_lens is CAMERA
    np.testing.assert_array_equal(CAMERA.color_from_depth, np.eye(4))


def test_two_lenses() -> None:
    lens = TWO_LENSES.depth_lens
    assert (lens.width, lens.height, lens.fx) == (32, 24, 26.0)
    matrix = TWO_LENSES.color_from_depth
    assert matrix.dtype == np.float64
    np.testing.assert_array_equal(matrix[:3, 3], (0.075, 0, -0.001))
    np.testing.assert_array_equal(matrix[1], (0, 0.8, -0.6, 0))


def test_the_depth_picture_has_its_own_lens_s_size() -> None:
    depth = np.arange(32 * 24, dtype=np.uint16).reshape(24, 32)
    np.testing.assert_array_equal(decode_depth(encode_depth(depth), TWO_LENSES), depth)
    with pytest.raises(ProtocolError, match="depth is 64x48, the session's camera is 32x24"):
        decode_depth(encode_depth(np.zeros((48, 64), np.uint16)), TWO_LENSES)


@pytest.mark.parametrize("model", [CameraModel, DepthCamera])
@pytest.mark.parametrize(
    ("change", "reason"),
    [
        ({"width": 7}, "width is 7, must be 8 to 4096"),
        ({"height": 4097}, "height is 4097, must be 8 to 4096"),
        ({"width": 1921, "height": 1200}, "1921x1200 pixels, more than 2304000 in all"),
        ({"width": 4096, "height": 4096}, "4096x4096 pixels, more than 2304000 in all"),
        ({"fx": 0.0}, "fx is 0.0, must be positive and finite"),
        ({"fy": float("inf")}, "fy is inf, must be positive and finite"),
        ({"cx": float("nan")}, "must be finite"),
        ({"distortion": (0.0, 0.0, float("inf"), 0.0, 0.0)}, "must be finite"),
    ],
)
def test_refuses_a_lens(model: Any, change: dict[str, Any], reason: str) -> None:
    with pytest.raises(ValueError, match=reason) as refused:
        model(**LENS | change)
    assert "\n" not in str(refused.value)
    assert str(refused.value).startswith("camera.depth" if model is DepthCamera else "camera")


@pytest.mark.parametrize("lens", ["camera", "camera.depth"])
@pytest.mark.parametrize(
    ("change", "reason"),
    [
        ({"fx": 1e-37}, "fx 1e-37 and .* farther than 85 degrees"),
        ({"fy": 1e9}, r"fy is 1e\+09, must be at most .* 1 degree for 48 pixels"),
        ({"cy": 1e30}, r"cy 1e\+30 see farther than 85 degrees"),
        ({"distortion": (0.0, -101.0, 0.0, 0.0, 0.0)}, "distortion has -101, more than 100"),
    ],
)
def test_a_camera_that_there_cannot_be_says_no_hello(lens: str, change: dict[str, Any], reason: str) -> None:
    own, depth = (change, {}) if lens == "camera" else ({}, change)
    camera = CameraModel(**LENS | own, depth=DepthCamera(**LENS | depth))
    with pytest.raises(ValueError, match=reason) as refused:
        Hello(client="test", camera=camera)
    assert str(refused.value).startswith(f"{lens}.")
    Hello(client="test", camera=CameraModel(**LENS))


@pytest.mark.parametrize("scale", [1e-38, 2.0])
def test_a_unit_of_depth_that_there_cannot_be_says_no_hello(scale: float) -> None:
    with pytest.raises(ValueError, match="must be 1e-06 to 1"):
        Hello(client="test", camera=CameraModel(**LENS, depth_scale_m=scale))


def test_takes_the_largest_picture() -> None:
    assert CameraModel(**LENS | {"width": 1920, "height": 1200, "fx": 900.0, "fy": 900.0}).width == 1920


@pytest.mark.parametrize("scale", [0.0, -0.001, float("nan"), float("inf")])
def test_refuses_a_depth_scale(scale: float) -> None:
    with pytest.raises(ValueError, match="depth_scale_m"):
        CameraModel(**LENS, depth_scale_m=scale)


@pytest.mark.parametrize(
    ("matrix", "reason"),
    [
        (IDENTITY[:12], "16 finite numbers"),
        (changed(IDENTITY, _3=float("nan")), "16 finite numbers"),
        (changed(IDENTITY, _0=float("inf")), "16 finite numbers"),
        (changed(IDENTITY, _0=1.1), "not a rotation"),
        (changed(IDENTITY, _0=1e300), "not a rotation"),
        (changed(IDENTITY, _0=-1.0), "not a rotation"),
        ((0.0,) * 15 + (1.0,), "not a rotation"),
        (changed(IDENTITY, _12=0.075), "last row is not 0 0 0 1: is it row-major"),
        (changed(IDENTITY, _15=0.0), "last row"),
        (changed(IDENTITY, _3=75.0), "moves by 75 m: is it in millimetres"),
    ],
)
def test_refuses_what_is_not_rigid(matrix: tuple[float, ...], reason: str) -> None:
    with pytest.raises(ValueError, match=reason) as refused:
        DepthCamera(**LENS, color_from_depth=matrix)
    assert str(refused.value).startswith("camera.depth.color_from_depth")
    assert "\n" not in str(refused.value)


def test_takes_a_rotation_with_few_digits() -> None:
    turned = (0.8660, -0.5, 0.0, 0.1, 0.5, 0.8660, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0)
    assert DepthCamera(**LENS, color_from_depth=turned).color_from_depth == turned


def test_is_refused_on_the_wire() -> None:
    plain = msgspec.to_builtins(TWO_LENSES)
    assert msgspec.convert(plain, CameraModel) == TWO_LENSES
    for field, value in (("width", 5), ("color_from_depth", [1.0] * 16), ("color_from_depth", [1.0] * 15)):
        with pytest.raises(msgspec.ValidationError):
            msgspec.convert(plain | {"depth": plain["depth"] | {field: value}}, CameraModel)
