"""Coding of a frame: quality and size of the colour picture, compression level and rounding of depth."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from client.streaming.depth_rounding import round_depth
from client.streaming.video import VideoEncoder
from protocol.frames import CameraModel, RgbdFrame
from protocol.images import DEFAULT_JPEG_QUALITY, encode_color, encode_depth
from protocol.messages import ColorImage, DepthCodec, DepthImage, Frame


@dataclass(frozen=True)
class Coding:
    """Coding parameters; the defaults suit a fast link."""

    quality: int = DEFAULT_JPEG_QUALITY
    """JPEG quality, 0 to 100; for video it is mapped to a rate factor."""
    divisor: int = 1
    """1, 2 or 4: colour is sent at 1/divisor of its width and height; the server enlarges it."""
    depth_level: int = 1
    """Level of zstd: 6 needs 5 % fewer bytes than 1, and 2 ms more for 640x480."""
    depth_noise_per_m: float | None = None
    """Depth may change by up to this times z^2 (metres); None: depth is exact."""
    depth_codec: DepthCodec = "zstd-ranks"


DEFAULT_CODING = Coding()


def frame_message(
    frame: RgbdFrame,
    camera: CameraModel,
    lossless: bool = False,
    coding: Coding = DEFAULT_CODING,
    video: VideoEncoder | None = None,
) -> Frame:
    """Encode a frame as a message. `lossless`: raw colour and exact depth, `coding` is ignored.

    `video`: encoder for colour; None: JPEG. Linear colour is always raw, and pictures with an odd side are JPEG.
    """
    pose = frame.world_from_camera
    return Frame(
        frame=frame.index,
        timestamp_s=frame.timestamp_s,
        world_from_camera=None if pose is None else tuple(pose.ravel().tolist()),
        color=_color(frame, camera, lossless, coding, video),
        depth=encode_depth(frame.depth, coding.depth_codec) if lossless else _depth(frame.depth, camera, coding),
        exposure=frame.exposure,
    )


def picture_bytes(message: Frame) -> int:
    """Bytes of colour and depth; the rest of the message is small."""
    return sum(len(picture.data) for picture in (message.color, message.depth) if picture is not None)


def _color(
    frame: RgbdFrame, camera: CameraModel, lossless: bool, coding: Coding, video: VideoEncoder | None
) -> ColorImage:
    if lossless or camera.color_encoding == "linear16":
        return encode_color(frame.color, "raw", camera.color_encoding)
    color = np.asarray(frame.color, np.uint8)
    if coding.divisor > 1:
        size = (-(-camera.width // coding.divisor), -(-camera.height // coding.divisor))
        color = cv2.resize(color, size, interpolation=cv2.INTER_AREA).astype(np.uint8, copy=False)
    if video is not None and video.can_encode(color.shape[1], color.shape[0]):
        return video.encode(color, coding.quality)
    return encode_color(color, "jpeg", quality=coding.quality)


def _depth(depth: NDArray[np.uint16], camera: CameraModel, coding: Coding) -> DepthImage:
    noise_per_m = coding.depth_noise_per_m
    if noise_per_m is not None:
        depth = round_depth(depth, noise_per_m, camera.depth_scale_m)
    return encode_depth(depth, coding.depth_codec, level=coding.depth_level, rounded_per_m=noise_per_m)
