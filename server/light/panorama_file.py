"""The light that arrives at a place as a lat-long file, Radiance .hdr or OpenEXR .exr.

Rows, columns and axes are those of panorama.py: the top row looks up, the middle column along the first camera's view.
"""

from __future__ import annotations

import struct
from collections.abc import Callable

import cv2
import numpy as np
from numpy.typing import NDArray

from protocol.messages import PanoramaFormat
from server.light.panorama import panorama_directions

WIDTH_PX, HEIGHT_PX = 1024, 512
"""0.35 degrees a pixel; a voxel of 1 cm is 0.6 degrees wide from 1 m."""
_ROWS = 64  # looked up at a time: 65536 directions, 2 MiB of the device's memory
_LARGEST_HALF = 65504.0
_HALF = 1

Floats = NDArray[np.float64]


def lat_long_radiance(radiance_from: Callable[[Floats], Floats], webxr_from_world: Floats) -> Floats:
    """[HEIGHT_PX, WIDTH_PX, 3] what `radiance_from` says of unit directions [m, 3] in world axes, as [m, 3].

    webxr_from_world: [3, 3] rotation into axes with +y up and the first view near -z.
    """
    directions = panorama_directions(HEIGHT_PX, WIDTH_PX) @ webxr_from_world
    parts = [radiance_from(directions[row : row + _ROWS].reshape(-1, 3)) for row in range(0, HEIGHT_PX, _ROWS)]
    return np.concatenate(parts).reshape(HEIGHT_PX, WIDTH_PX, 3)


def encode_panorama(radiance: Floats, format_: PanoramaFormat) -> bytes:
    """The file of [h, w, 3] linear RGB radiance, not negative. Equal radiance gives equal bytes."""
    return exr_bytes(radiance) if format_ == "exr" else _hdr_bytes(radiance)


def decode_hdr(data: bytes) -> Floats:
    """[h, w, 3] linear RGB radiance of a Radiance .hdr. Raises ValueError if it is none."""
    picture = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    if picture is None or picture.dtype != np.float32 or picture.ndim != 3:
        raise ValueError("is no Radiance .hdr picture")
    return picture[..., ::-1].astype(np.float64)


def _hdr_bytes(radiance: Floats) -> bytes:
    """Radiance RGBE: a common exponent, so that each channel is good to 1/256 of the brightest one."""
    done, data = cv2.imencode(".hdr", np.ascontiguousarray(radiance[..., ::-1], np.float32))
    if not done:
        raise ValueError(f"OpenCV could not encode a panorama of {radiance.shape} as .hdr")
    found: bytes = data.tobytes()
    return found


def exr_bytes(radiance: Floats) -> bytes:
    """OpenEXR 2.0, scan lines of half floats without compression ("OpenEXR File Layout", openexr.com).

    OpenCV's packages are built without OpenEXR. Radiance above 65504, the largest half, is written as 65504.
    """
    height, width = radiance.shape[:2]
    header = _exr_header(width, height)
    lines = np.minimum(radiance, _LARGEST_HALF).astype("<f2")[..., ::-1].transpose(0, 2, 1)  # B, G, R: by name
    line_bytes = 8 + lines[0].nbytes
    first = len(header) + 8 * height
    offsets = struct.pack(f"<{height}Q", *range(first, first + height * line_bytes, line_bytes))
    blocks = b"".join(struct.pack("<ii", y, line.nbytes) + line.tobytes() for y, line in enumerate(lines))
    return header + offsets + blocks


def _exr_header(width: int, height: int) -> bytes:
    channels = b"".join(name + b"\0" + struct.pack("<iB3xii", _HALF, 0, 1, 1) for name in (b"B", b"G", b"R")) + b"\0"
    window = struct.pack("<4i", 0, 0, width - 1, height - 1)
    attributes = (
        (b"channels", b"chlist", channels),
        (b"compression", b"compression", b"\0"),  # none
        (b"dataWindow", b"box2i", window),
        (b"displayWindow", b"box2i", window),
        (b"lineOrder", b"lineOrder", b"\0"),  # increasing y
        (b"pixelAspectRatio", b"float", struct.pack("<f", 1.0)),
        (b"screenWindowCenter", b"v2f", struct.pack("<2f", 0.0, 0.0)),
        (b"screenWindowWidth", b"float", struct.pack("<f", 1.0)),
    )
    fields = (name + b"\0" + kind + b"\0" + struct.pack("<i", len(data)) + data for name, kind, data in attributes)
    return struct.pack("<ii", 20000630, 2) + b"".join(fields) + b"\0"  # the magic number, and version 2
