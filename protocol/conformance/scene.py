"""The small scene of the checks: a grey wall 1.5 m away, 32 x 24 pixels, and a triangle to place in front of it."""

from __future__ import annotations

import struct
import zlib
from typing import Any

WIDTH, HEIGHT = 32, 24
DEPTH_MM, GREY = 1500, 180
CAMERA = {"width": WIDTH, "height": HEIGHT, "fx": 30.0, "fy": 30.0, "cx": 15.5, "cy": 11.5}
IDENTITY = [1.0, 0, 0, 0, 0, 1.0, 0, 0, 0, 0, 1.0, 0, 0, 0, 0, 1.0]
WISHES = {"preset": "reg8", "volume_m": [-1, -1, 0.5, 1, 1, 2.5], "voxel_m": 0.02}
TRIANGLE_OBJ = b"v 0 0 0\nv 0.2 0 0\nv 0 0.2 0\nv 0 0 0.2\nf 1 2 3\nf 1 2 4\nf 2 3 4\nf 1 3 4\n"


def hello(**fields: Any) -> dict[str, Any]:
    """A capturing client's first message; `fields` are added or replaced."""
    return {"type": "hello", "client": "conformance", "camera": CAMERA, "wishes": WISHES, **fields}


def frame(number: int, **fields: Any) -> dict[str, Any]:
    """Frame `number` of the wall; `fields` are added or replaced."""
    size = {"width": WIDTH, "height": HEIGHT, "codec": "raw"}
    message = {"type": "frame", "frame": number, "timestamp_s": number / 30, "world_from_camera": IDENTITY}
    message["color"] = {**size, "data": bytes([GREY]) * (3 * WIDTH * HEIGHT)}
    message["depth"] = {**size, "data": DEPTH_MM.to_bytes(2, "little") * (WIDTH * HEIGHT)}
    return {**message, **fields}


def place(request: int, name: str = "pyramid") -> dict[str, Any]:
    """A request to place the pyramid in front of the wall."""
    message = {"type": "place_object", "request": request, "object": name, "format": "obj", "data": TRIANGLE_OBJ}
    return {**message, "position_m": [0, 0.2, 1.2]}


def grey_png(width: int, height: int) -> bytes:
    """An 8-bit RGB PNG of one grey."""
    rows = (b"\0" + bytes([GREY]) * (3 * width)) * height
    parts = (
        (b"IHDR", struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)),
        (b"IDAT", zlib.compress(rows)),
        (b"IEND", b""),
    )
    chunks = (struct.pack(">I", len(d)) + k + d + struct.pack(">I", zlib.crc32(k + d)) for k, d in parts)
    return b"\x89PNG\r\n\x1a\n" + b"".join(chunks)
