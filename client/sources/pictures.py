"""Reading of colour and depth pictures; damaged files are refused.

Files are checked before decoding, because libjpeg and libpng return the readable part of a truncated picture.
"""

from __future__ import annotations

import zlib
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from client.errors import SourceError
from protocol.limits import MAX_IMAGE_PIXELS, MAX_IMAGE_SIDE_PX

NO_DEPTH = 65535
"""Value of pixels without measurement in some data sets; becomes 0."""

_PNG_SIGNATURE = b"\x89PNG\r\n\x1a\n"
_JPEG_START, _JPEG_SCAN, _JPEG_END = b"\xff\xd8", 0xDA, b"\xff\xd9"


def read_color(path: Path) -> NDArray[np.uint8] | NDArray[np.uint16]:
    """[height, width, 3] RGB, uint8 or uint16 as in the file. Raises SourceError."""
    return decode_color(_read_bytes(path), path)


def decode_color(data: bytes, where: object) -> NDArray[np.uint8] | NDArray[np.uint16]:
    """As `read_color`, of the bytes of a PNG or JPEG; `where` names them in errors. Raises SourceError."""
    picture = _decode(data, cv2.IMREAD_COLOR_RGB | cv2.IMREAD_ANYDEPTH, where)
    if picture.dtype not in (np.uint8, np.uint16):
        raise SourceError(f"{where}: colour must have 8 or 16 bits, not {picture.dtype}")
    return picture


def read_depth(path: Path) -> NDArray[np.uint16]:
    """[height, width] uint16 in the unit of the data set, 0: no measurement (65535 becomes 0). Raises SourceError."""
    picture = _decode(_read_bytes(path), cv2.IMREAD_UNCHANGED, path)
    if picture.dtype != np.uint16 or picture.ndim != 2:
        raise SourceError(f"{path}: depth must be one channel of 16 bits, not {picture.dtype} {picture.shape}")
    picture[picture == NO_DEPTH] = 0
    return picture


def read_gray(path: Path) -> NDArray[np.uint8]:
    """[height, width] uint8 of a picture of one channel, for example of confidences. Raises SourceError."""
    picture = _decode(_read_bytes(path), cv2.IMREAD_UNCHANGED, path)
    if picture.dtype != np.uint8 or picture.ndim != 2:
        raise SourceError(f"{path}: must be one channel of 8 bits, not {picture.dtype} {picture.shape}")
    return picture


def _decode(data: bytes, flags: int, path: object) -> NDArray[Any]:
    _require_complete(data, path)
    try:
        picture = cv2.imdecode(np.frombuffer(data, np.uint8), flags)
    except cv2.error as error:
        raise SourceError(f"{path}: cannot be decoded as a picture; fetch the file again") from error
    if picture is None:
        raise SourceError(f"{path}: cannot be decoded as a picture; fetch the file again")
    _require_size(picture, path)
    return picture


def _read_bytes(path: Path) -> bytes:
    try:
        data = path.read_bytes()
    except OSError as error:
        raise SourceError(f"{path}: cannot be read ({error.strerror})") from error
    if not data:
        raise SourceError(f"{path}: the file is empty; fetch it again")
    return data


def _require_size(picture: NDArray[Any], path: object) -> None:
    height, width = picture.shape[:2]
    if max(height, width) > MAX_IMAGE_SIDE_PX or height * width > MAX_IMAGE_PIXELS:
        raise SourceError(f"{path}: {width}x{height} is more than the {MAX_IMAGE_PIXELS} pixels a frame may have")


def _require_complete(data: bytes, path: object) -> None:
    if data.startswith(_PNG_SIGNATURE):
        complete = _png_is_complete(data)
    elif data.startswith(_JPEG_START):
        complete = _jpeg_is_complete(data)
    else:
        raise SourceError(f"{path}: is neither a PNG nor a JPEG picture")
    if not complete:
        raise SourceError(f"{path}: the picture is truncated or damaged; fetch the file again")


def _png_is_complete(data: bytes) -> bool:
    """Whether all chunks up to IEND exist and match their checksums."""
    at = len(_PNG_SIGNATURE)
    while at + 12 <= len(data):
        length = int.from_bytes(data[at : at + 4], "big")
        body_end = at + 8 + length
        if body_end + 4 > len(data):
            return False
        if zlib.crc32(data[at + 4 : body_end]) != int.from_bytes(data[body_end : body_end + 4], "big"):
            return False
        if data[at + 4 : at + 8] == b"IEND":
            return True
        at = body_end + 4
    return False


def _jpeg_is_complete(data: bytes) -> bool:
    """Whether the end marker follows the scan. The header is skipped, as its thumbnails have end markers too."""
    at = 2
    while at + 4 <= len(data) and data[at] == 0xFF:
        marker = data[at + 1]
        at += 2 + int.from_bytes(data[at + 2 : at + 4], "big")
        if marker == _JPEG_SCAN:
            return data.find(_JPEG_END, at) >= 0
    return False
