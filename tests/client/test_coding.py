"""How frames are encoded: reduced pictures, rounded depth and its bound, and what the wire says of it."""

from __future__ import annotations

import msgspec
import numpy as np
import pytest

from client.errors import OptionError
from client.options.capture import refuse_color
from client.streaming.coding import Coding, frame_message, picture_bytes
from client.streaming.depth_rounding import round_depth
from client.streaming.video import VideoEncoder
from protocol.codec import ProtocolError, decode_client, encode
from protocol.frames import CameraModel, RgbdFrame
from protocol.images import decode_color, decode_depth, encode_color
from tests.data import data_folder

CAMERA = CameraModel(width=97, height=65, fx=90.0, fy=90.0, cx=48.0, cy=32.0)
ALL_DEPTHS = np.arange(65536, dtype=np.uint16).reshape(256, 256)


def a_frame(camera: CameraModel = CAMERA) -> RgbdFrame:
    y, x = np.mgrid[0 : camera.height, 0 : camera.width]
    color = np.stack([2 * x, 3 * y, x + y], axis=-1).astype(np.uint8)
    depth = (1500 + 300 * np.sin(x / 9) + np.random.default_rng(1).normal(0, 2, x.shape)).astype(np.uint16)
    depth[:4, :7] = 0
    return RgbdFrame(3, 0.5, color, depth, None)


@pytest.mark.parametrize("divisor", [1, 2, 4])
def test_a_reduced_picture_is_enlarged_to_the_cameras_size(divisor: int) -> None:
    frame = a_frame()
    message = decode_client(encode(frame_message(frame, CAMERA, coding=Coding(90, divisor))))
    assert (message.color.width, message.color.height) == (-(-97 // divisor), -(-65 // divisor))
    color = decode_color(message.color, CAMERA)
    assert color.shape == frame.color.shape
    assert color.dtype == np.uint8
    assert np.abs(color.astype(int) - frame.color).mean() < 2 * divisor
    np.testing.assert_array_equal(decode_depth(message.depth, CAMERA), frame.depth)


def test_only_half_and_quarter_jpegs_are_taken() -> None:
    small = a_frame(msgspec.structs.replace(CAMERA, width=33, height=22)).color
    with pytest.raises(ProtocolError, match="color is 33x22, the session's camera is 97x65"):
        decode_color(encode_color(small), CAMERA)
    half = a_frame(msgspec.structs.replace(CAMERA, width=49, height=33)).color
    assert decode_color(encode_color(half), CAMERA).shape == (65, 97, 3)
    with pytest.raises(ProtocolError, match="color is 49x33"):
        decode_color(encode_color(half, "png"), CAMERA)


def test_lossless_keeps_every_bit_whatever_the_coding_says() -> None:
    frame = a_frame()
    message = frame_message(frame, CAMERA, True, Coding(10, 4, depth_noise_per_m=0.05))
    np.testing.assert_array_equal(decode_color(message.color, CAMERA), frame.color)
    np.testing.assert_array_equal(decode_depth(message.depth, CAMERA), frame.depth)
    assert message.depth.rounded_per_m is None


def test_linear_colour_stays_raw() -> None:
    linear = msgspec.structs.replace(CAMERA, color_encoding="linear16")
    frame = a_frame()
    wide = RgbdFrame(0, 0.0, frame.color.astype(np.uint16) * 257, frame.depth, None)
    assert frame_message(wide, linear, coding=Coding(50, 2)).color.codec == "raw"


@pytest.mark.parametrize(("noise_per_m", "scale_m"), [(0.0014, 0.001), (0.006, 0.001), (0.002, 0.0002), (0.003, 0.004)])
def test_no_depth_moves_further_than_the_bound(noise_per_m: float, scale_m: float) -> None:
    rounded = round_depth(ALL_DEPTHS, noise_per_m, scale_m)
    z = ALL_DEPTHS * scale_m
    moved_m = np.abs(rounded.astype(float) - ALL_DEPTHS) * scale_m
    assert (moved_m <= noise_per_m * z**2 + 1e-12).all()
    assert rounded[0, 0] == 0
    assert (rounded[ALL_DEPTHS > 0] > 0).all()
    near = (z > 1) & (z < 4)
    wide = near & (2 * noise_per_m * z**2 > 4 * scale_m)
    if wide.any():  # where steps are wider than units there are fewer values than before
        assert len(np.unique(rounded[wide])) < 0.5 * wide.sum()
        assert moved_m[wide].max() > 0.5 * noise_per_m
    if 2 * noise_per_m * 2**2 > 4 * scale_m:
        metres = rounded[(z > 2) & (z < 4)] * scale_m
        assert len(np.unique(metres)) < 1.8 * (1 / 2 - 1 / 4) / (2 * noise_per_m)


def test_the_wire_says_by_how_much_depth_was_rounded() -> None:
    frame = a_frame()
    exact, rounded = (frame_message(frame, CAMERA, coding=Coding(depth_noise_per_m=n)) for n in (None, 0.003))
    assert b"rounded_per_m" not in encode(exact)
    assert decode_client(encode(rounded)).depth.rounded_per_m == 0.003
    assert len(rounded.depth.data) < 0.8 * len(exact.depth.data)
    assert picture_bytes(rounded) == len(rounded.depth.data) + len(rounded.color.data)


def test_pictures_of_odd_sides_stay_jpeg_beside_video() -> None:
    pytest.importorskip("av")
    video, even = VideoEncoder(), msgspec.structs.replace(CAMERA, width=96, height=64)
    found = [
        frame_message(a_frame(camera), camera, coding=Coding(80, divisor), video=video).color
        for camera, divisor in ((CAMERA, 1), (CAMERA, 2), (even, 1), (even, 2))
    ]
    assert [(image.codec, image.width) for image in found] == [("jpeg", 97), ("jpeg", 49), ("h264", 96), ("h264", 48)]


@pytest.mark.parametrize(("codec", "lossless", "words"), [("hevc", False, "h264"), ("h264", True, "--lossless")])
def test_video_that_cannot_be_is_refused(codec: str, lossless: bool, words: str) -> None:
    with pytest.raises(OptionError, match=words):
        refuse_color(codec, lossless)


def test_without_its_library_video_is_refused_with_what_to_do(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("client.streaming.video.IS_POSSIBLE", False)
    with pytest.raises(OptionError, match="needs PyAV, which is not installed: make install-video"):
        refuse_color("h264", False)
    refuse_color(None, False)


@pytest.mark.data
def test_the_kitchen_takes_fewer_bytes_on_every_rung() -> None:
    from client.options.source import open_source
    from client.streaming.adaptive import LADDER

    source = open_source(str(data_folder("rgbd_7scenes_redkitchen")))
    sizes = [picture_bytes(frame_message(source[0], source.camera, coding=rung)) for rung in LADDER]
    assert sizes == sorted(sizes, reverse=True)
    rounded = Coding(depth_noise_per_m=0.00285)
    depths = [frame_message(source[0], source.camera, coding=coding).depth for coding in (rounded, Coding())]
    assert len(depths[0].data) < 0.8 * len(depths[1].data)
