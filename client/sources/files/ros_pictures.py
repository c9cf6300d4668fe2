"""Pictures of ROS messages: sensor_msgs Image and CompressedImage."""

from __future__ import annotations

import struct
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from client.errors import SourceError
from client.sources.pictures import NO_DEPTH, decode_color

_COLOR = {"rgb8": (3, "rgb"), "bgr8": (3, "bgr"), "rgba8": (4, "rgb"), "bgra8": (4, "bgr"), "8UC3": (3, "bgr")}
"""Encoding -> channels and their order; 8UC3 is OpenCV's, so BGR."""
_DEPTH = {"16UC1": 2, "mono16": 2, "32FC1": 4}
"""Encoding -> bytes a pixel."""
_DEPTH_HEADER = struct.Struct("<iff")
"""Of compressed_depth_image_transport, before its PNG: format and two coefficients of float depth."""


def is_color(message: Any) -> bool:
    """Whether a picture is in colour, in an encoding that is read."""
    return message.encoding in _COLOR if hasattr(message, "encoding") else "compressedDepth" not in message.format


def is_depth(message: Any) -> bool:
    """Whether a picture is depth, in an encoding that is read."""
    if hasattr(message, "encoding"):
        return message.encoding in _DEPTH
    return "compressedDepth" in message.format and "16UC1" in message.format


def color_of(message: Any, where: str) -> NDArray[np.uint8]:
    """[h, w, 3] RGB. Raises SourceError with `where`."""
    if not hasattr(message, "encoding"):
        picture = decode_color(bytes(message.data), where)
        if picture.dtype != np.uint8:
            raise SourceError(f"{where}: compressed colour must have 8 bits, not {picture.dtype}")
        return picture.astype(np.uint8)
    channels, order = _COLOR[message.encoding]
    pixels = _rows(message, channels, where).reshape(message.height, message.width, channels)[..., :3]
    return np.ascontiguousarray(pixels if order == "rgb" else pixels[..., ::-1], np.uint8)


def depth_of(message: Any, where: str) -> NDArray[Any]:
    """[h, w] uint16 millimetres, 0: none, or float32 metres. Raises SourceError with `where`."""
    if not hasattr(message, "encoding"):
        depth = cv2.imdecode(np.asarray(message.data)[_DEPTH_HEADER.size :], cv2.IMREAD_UNCHANGED)
        if depth is None or depth.dtype != np.uint16 or depth.ndim != 2:
            raise SourceError(f"{where}: its compressed depth is no PNG of 16 bits")
    else:
        size = _DEPTH[message.encoding]
        kind = np.dtype(np.float32 if size == 4 else np.uint16).newbyteorder(">" if message.is_bigendian else "<")
        depth = _rows(message, size, where).view(kind).reshape(message.height, message.width)
    if depth.dtype.kind == "f":
        return depth.astype(np.float32)
    return np.where(depth == NO_DEPTH, 0, depth).astype(np.uint16)


def _rows(message: Any, pixel_bytes: int, where: str) -> NDArray[np.uint8]:
    """[h, w * pixel_bytes] without the padding at the end of rows."""
    data, row = np.asarray(message.data, np.uint8), message.width * pixel_bytes
    if message.step < row or len(data) < message.step * message.height:
        raise SourceError(f"{where}: has fewer bytes than its {message.width}x{message.height} pixels")
    rows = data[: message.step * message.height].reshape(message.height, message.step)[:, :row]
    return np.ascontiguousarray(rows)
