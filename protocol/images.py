"""Converts colour and depth images between arrays and wire payloads. Payloads are validated before decoding."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Literal, get_args

import cv2
import numpy as np
from numpy.typing import NDArray

from protocol.codec import ProtocolError
from protocol.depth_codec import (
    LEVEL,
    deflate,
    filter_depth,
    inflate,
    most_rank_bytes,
    rank_depth,
    unfilter_depth,
    unrank_depth,
    zstd_compress,
    zstd_decompress,
)
from protocol.frames import CameraModel, ColorEncoding, DepthCamera
from protocol.messages import ColorCodec, ColorImage, DepthCodec, DepthImage, Payload
from protocol.picture_headers import jpeg_size, png_size

StillCodec = Literal["jpeg", "png", "raw"]
"""Codecs of independent images."""
Color = NDArray[np.uint8] | NDArray[np.uint16]

DEFAULT_DEPTH_CODEC: DepthCodec = "zstd-delta"
DEPTH_CODECS: tuple[DepthCodec, ...] = get_args(DepthCodec)
DEFAULT_JPEG_QUALITY = 90
REDUCIBLE = ("jpeg", "h264")
"""Colour codecs whose images may be smaller than the camera's."""

_COLOR_DTYPE: dict[ColorEncoding, str] = {"srgb8": "u1", "linear16": "<u2"}
# An EXIF orientation must not turn a picture whose size has been checked.
_READ_RGB = cv2.IMREAD_COLOR_RGB | cv2.IMREAD_IGNORE_ORIENTATION


def encode_color(
    rgb: Color, codec: StillCodec = "jpeg", encoding: ColorEncoding = "srgb8", quality: int = DEFAULT_JPEG_QUALITY
) -> ColorImage:
    """[h, w, 3] RGB -> payload. uint8 sRGB (`srgb8`), or uint16 linear (`linear16`, codec `raw` only).

    `quality` is JPEG's, 0 to 100. Raises ValueError if dtype, encoding and codec do not match.
    """
    dtype = np.uint8 if encoding == "srgb8" else np.uint16
    if rgb.ndim != 3 or rgb.shape[2] != 3 or rgb.dtype != dtype:
        raise ValueError(f"colour of {encoding} must be [h, w, 3] {dtype.__name__}, is {rgb.shape} {rgb.dtype}")
    _require_codec(codec, encoding)
    height, width = rgb.shape[:2]
    data = _compress_color(rgb, codec, encoding, quality)
    return ColorImage(width=width, height=height, data=data, codec=codec, encoding=encoding)


def decode_color(
    image: ColorImage,
    camera: CameraModel,
    encoding: ColorEncoding | None = None,
    decompress: Callable[[bytes], NDArray[np.uint8]] | None = None,
    video: Callable[[ColorImage], NDArray[np.uint8]] | None = None,
) -> Color:
    """Payload -> [h, w, 3] RGB, uint8 (`srgb8`) or uint16 (`linear16`), of exactly the camera's size.

    A JPEG or video image of a half or a quarter of the camera's size, rounded up, is enlarged. `encoding` is the
    expected one: None means the camera's; a composite is always `srgb8`. `decompress` decodes a JPEG or PNG whose
    header is validated (default: `decode_picture`). `video` validates and decodes an H.264 picture; without it H.264 is
    refused.
    Raises ProtocolError, before anything is allocated, for an image that does not match its declaration.
    """
    expected = encoding or camera.color_encoding
    if image.encoding != expected:
        raise ProtocolError(f"color.encoding is {image.encoding}, this session's is {expected}")
    _require_codec(image.codec, image.encoding)
    if image.codec not in REDUCIBLE or (image.width, image.height) not in reduced_sizes(camera):
        _require_size("color", image, camera)
    if image.codec == "raw":
        return _raw("color", image, _COLOR_DTYPE[image.encoding], 3).reshape(image.height, image.width, 3)
    rgb = _of_video(image, video) if image.codec == "h264" else _decompress_color(image, decompress or decode_picture)
    if (image.width, image.height) == (camera.width, camera.height):
        return rgb
    return cv2.resize(rgb, (camera.width, camera.height), interpolation=cv2.INTER_LINEAR).astype(np.uint8, copy=False)


def reduced_sizes(camera: CameraModel) -> tuple[tuple[int, int], ...]:
    """Width and height of a colour image at a half and at a quarter of the camera's size, rounded up."""
    return tuple((-(-camera.width // divisor), -(-camera.height // divisor)) for divisor in (2, 4))


def decode_picture(data: bytes) -> NDArray[np.uint8]:
    """A JPEG or PNG with validated header -> [h, w, 3] RGB. Raises ProtocolError."""
    try:
        rgb = cv2.imdecode(np.frombuffer(data, np.uint8), _READ_RGB)
    except cv2.error as error:
        raise ProtocolError(f"color.data cannot be decoded: {error}") from error
    if rgb is None:
        raise ProtocolError("color.data cannot be decoded")
    return rgb.astype(np.uint8, copy=False)


def encode_depth(
    depth: NDArray[np.uint16],
    codec: DepthCodec = DEFAULT_DEPTH_CODEC,
    *,
    level: int = LEVEL,
    rounded_per_m: float | None = None,
) -> DepthImage:
    """[h, w] uint16, 0 = no measurement -> payload, bit-exact. Raises ValueError for another shape or dtype.

    `level` is zstd's: higher takes fewer bytes and more time. `rounded_per_m`: rounding applied to `depth` before.
    """
    if depth.ndim != 2 or depth.dtype != np.uint16:
        raise ValueError(f"depth must be [h, w] uint16, is {depth.shape} {depth.dtype}")
    height, width = depth.shape
    match codec:
        case "raw":
            data = depth.astype("<u2").tobytes()
        case "zdelta":
            data = deflate(filter_depth(depth))
        case "zranks":
            data = deflate(rank_depth(depth))
        case "zstd-delta":
            data = zstd_compress(filter_depth(depth), level)
        case "zstd-ranks":
            data = zstd_compress(rank_depth(depth), level)
    return DepthImage(width=width, height=height, data=data, codec=codec, rounded_per_m=rounded_per_m)


def decode_depth(image: DepthImage, camera: CameraModel) -> NDArray[np.uint16]:
    """Payload -> [h, w] uint16 in units of `camera.depth_scale_m`, 0 = no measurement, of `camera.depth_lens`'s size.

    Raises ProtocolError, before anything is allocated, for an image that does not match its declaration.
    """
    _require_size("depth", image, camera.depth_lens)
    if image.codec == "raw":
        return _raw("depth", image, "<u2", 1).reshape(image.height, image.width)
    decompress = inflate if image.codec in ("zdelta", "zranks") else zstd_decompress
    if image.codec in ("zranks", "zstd-ranks"):
        most = most_rank_bytes(image.width, image.height)
        return unrank_depth(decompress(image.data, most, least_bytes=0), image.width, image.height)
    return unfilter_depth(decompress(image.data, 2 * image.width * image.height), image.width, image.height)


def _require_codec(codec: ColorCodec, encoding: ColorEncoding) -> None:
    if codec != "raw" and encoding != "srgb8":
        raise ProtocolError(f"color.codec {codec} carries srgb8 only; send {encoding} as raw")


def _require_size(field: str, image: Payload, lens: CameraModel | DepthCamera) -> None:
    if (image.width, image.height) != (lens.width, lens.height):
        declared = f"{field} is {image.width}x{image.height}"
        raise ProtocolError(f"{declared}, the session's camera is {lens.width}x{lens.height}")


def _raw(field: str, image: Payload, dtype: str, channels: int) -> NDArray[Any]:
    """The bytes as a writable native array of `dtype`, after checking that their number is the declared one."""
    expected = image.width * image.height * channels * np.dtype(dtype).itemsize
    if len(image.data) != expected:
        raise ProtocolError(f"{field}.data has {len(image.data)} bytes, {image.width}x{image.height} needs {expected}")
    return np.frombuffer(image.data, dtype).astype(np.dtype(dtype).newbyteorder("="))


def _compress_color(rgb: Color, codec: StillCodec, encoding: ColorEncoding, quality: int) -> bytes:
    if codec == "raw":
        return rgb.astype(_COLOR_DTYPE[encoding]).tobytes()
    # OpenCV's default PNG settings take half the time of level 1 and give no more bytes.
    options = (cv2.IMWRITE_JPEG_QUALITY, quality) if codec == "jpeg" else ()
    done, buffer = cv2.imencode(f".{codec}", cv2.cvtColor(rgb, cv2.COLOR_RGB2BGR), options)
    if not done:
        raise ValueError(f"OpenCV could not encode a picture of {rgb.shape} as {codec}")
    data: bytes = buffer.tobytes()
    return data


def _of_video(image: ColorImage, video: Callable[[ColorImage], NDArray[np.uint8]] | None) -> NDArray[np.uint8]:
    if video is None:
        raise ProtocolError("color.codec is h264, whose pictures are read one after the other only")
    rgb = video(image)
    if rgb.shape != (image.height, image.width, 3):
        raise ProtocolError(f"color.data is a picture of {rgb.shape[1]}x{rgb.shape[0]}, not of what color declares")
    return rgb


def _decompress_color(image: ColorImage, decompress: Callable[[bytes], NDArray[np.uint8]]) -> NDArray[np.uint8]:
    """Decode a JPEG or PNG after comparing its header with the payload's declaration."""
    size = (jpeg_size if image.codec == "jpeg" else png_size)(image.data)
    if size != (image.width, image.height):
        found = f"color.data is a picture of {size[0]}x{size[1]}"
        raise ProtocolError(f"{found}, color declares {image.width}x{image.height}")
    rgb = decompress(image.data)
    if rgb.shape != (image.height, image.width, 3):
        raise ProtocolError(f"color.data cannot be decoded as {image.codec}")
    return rgb
