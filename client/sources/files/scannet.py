"""ScanNet's .sens, version 4: colour as JPEG or PNG, depth as uint16, one camera_to_world a frame. Little-endian.

    uint32 version, uint64 length and text of the sensor's name,
    float32 [4, 4] each: intrinsics and extrinsics of colour, intrinsics and extrinsics of depth,
    int32 compression of colour (0 raw, 1 PNG, 2 JPEG) and depth (0 raw, 1 zlib, 2 OCCI),
    uint32 width and height of colour and of depth, float32 depth units a metre, uint64 number of frames;
    a frame: float32 [4, 4] camera_to_world, uint64 times of colour and depth (microseconds), uint64 sizes, the two data

The pose is of the depth camera, axes as OpenCV's; -inf where tracking
was lost: such frames are left out. Extrinsics take points of a lens to a common frame; they are unit matrices in the
published set.
"""

from __future__ import annotations

import struct
import zlib
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from client.errors import SourceError
from client.progress import note
from client.sources.datasets.decoded import DecodedSource, Lens, camera_of, frame_rate
from client.sources.pictures import decode_color
from client.sources.poses import rigid
from protocol.limits import MAX_IMAGE_PIXELS

LOOKED_FOR = "a .sens file of version 4 (ScanNet)"
VERSION = 4
DEFAULT_FPS = 30.0

_LONGEST_NAME = 4096
_PNG, _JPEG = 1, 2
_RAW_DEPTH, _ZLIB_DEPTH = 0, 1
_FRAME = struct.Struct("<16f4Q")
_SIZES = struct.Struct("<2i4If")


@dataclass(frozen=True)
class _Frame:
    pose: NDArray[np.float64]
    """camera_to_world [4, 4]; not finite where tracking was lost."""
    time_us: int
    at: int
    """Position of the colour in the file; depth follows."""
    color_bytes: int
    depth_bytes: int


@dataclass(frozen=True)
class _Header:
    color: Lens
    depth: Lens
    color_from_depth: NDArray[np.float64]
    color_kind: int
    depth_kind: int
    depth_scale_m: float


def recognises(path: Path, head: bytes) -> bool:
    """Whether the file begins with version 4, a plausible length of a name, and is named .sens."""
    if len(head) < 12 or path.suffix.lower() != ".sens":
        return False
    version, length = struct.unpack_from("<IQ", head)
    return bool(version == VERSION and length <= _LONGEST_NAME)


def open_file(path: Path) -> DecodedSource:
    """The capture in `path`, which `recognises` has accepted. Raises SourceError."""
    with path.open("rb") as file:
        header, frames = _header(path, file), _frames(path, file)
    placed = [frame for frame in frames if np.isfinite(frame.pose).all()]
    if not placed:
        raise SourceError(f"{path}: holds no frame with a pose; download the file again")
    if len(placed) < len(frames):
        note(f"{path.name}: tracking was lost in {len(frames) - len(placed)} of {len(frames)} frames; left out")
    depth_from_color = np.linalg.inv(header.color_from_depth)
    poses = tuple(rigid(f.pose, f"{path}: pose of frame {i}") @ depth_from_color for i, f in enumerate(placed))
    stamped = placed[-1].time_us > placed[0].time_us
    times_s = tuple(f.time_us * 1e-6 if stamped else i / DEFAULT_FPS for i, f in enumerate(placed))
    camera = camera_of(path, header.color, header.depth, header.color_from_depth, depth_scale_m=header.depth_scale_m)
    read = partial(_read, path, header, placed)
    return DecodedSource(path.name, camera, frame_rate(times_s, DEFAULT_FPS), None, times_s, poses, read)


def _header(path: Path, file: BinaryIO) -> _Header:
    (length,) = struct.unpack("<4xQ", _bytes(path, file, 12))
    _bytes(path, file, length)
    matrices = np.frombuffer(_bytes(path, file, 256), "<f4").reshape(4, 4, 4).astype(np.float64)
    sizes = _SIZES.unpack(_bytes(path, file, _SIZES.size))
    color_kind, depth_kind, color_width, color_height, depth_width, depth_height, shift = sizes
    if color_kind not in (_PNG, _JPEG) or depth_kind not in (_RAW_DEPTH, _ZLIB_DEPTH):
        raise SourceError(
            f"{path}: colour of kind {color_kind} and depth of kind {depth_kind} are not read; "
            "colour must be PNG or JPEG (1, 2), depth raw or zlib (0, 1)"
        )
    if not 0 < shift < np.inf or not 0 < depth_width * depth_height <= MAX_IMAGE_PIXELS:
        raise SourceError(f"{path}: its header is damaged; download the file again")
    extrinsics = [rigid(matrices[i], f"{path}: extrinsics") for i in (1, 3)]
    return _Header(
        color=_lens(color_width, color_height, matrices[0]),
        depth=_lens(depth_width, depth_height, matrices[2]),
        color_from_depth=np.linalg.inv(extrinsics[0]) @ extrinsics[1],
        color_kind=color_kind,
        depth_kind=depth_kind,
        depth_scale_m=1 / shift,
    )


def _lens(width: int, height: int, matrix: NDArray[np.float64]) -> Lens:
    return Lens(width, height, *(float(matrix[at]) for at in ((0, 0), (1, 1), (0, 2), (1, 2))))


def _frames(path: Path, file: BinaryIO) -> list[_Frame]:
    (count,) = struct.unpack("<Q", _bytes(path, file, 8))
    end = path.stat().st_size
    frames: list[_Frame] = []
    for _ in range(count):
        *matrix, color_us, _depth_us, color_bytes, depth_bytes = _FRAME.unpack(_bytes(path, file, _FRAME.size))
        at = file.tell()
        if at + color_bytes + depth_bytes > end:
            raise SourceError(f"{path}: ends in frame {len(frames)} of {count}; download the file again")
        frames.append(_Frame(np.array(matrix).reshape(4, 4), color_us, at, color_bytes, depth_bytes))
        file.seek(at + color_bytes + depth_bytes)
    return frames


def _read(path: Path, header: _Header, frames: list[_Frame], index: int) -> tuple[NDArray[Any], NDArray[np.uint16]]:
    frame = frames[index]
    with path.open("rb") as file:
        file.seek(frame.at)
        color, data = _bytes(path, file, frame.color_bytes), _bytes(path, file, frame.depth_bytes)
    lens, where = header.depth, f"{path}: frame {index}"
    if header.depth_kind == _ZLIB_DEPTH:
        try:
            data = zlib.decompressobj().decompress(data, 2 * lens.width * lens.height)
        except zlib.error as error:
            raise SourceError(f"{where}: its depth is damaged; download the file again") from error
    if len(data) != 2 * lens.width * lens.height:
        raise SourceError(f"{where}: its depth has {len(data)} bytes, not those of {lens.width}x{lens.height} pixels")
    depth = np.frombuffer(data, "<u2").reshape(lens.height, lens.width).astype(np.uint16)
    return decode_color(color, where), depth


def _bytes(path: Path, file: BinaryIO, count: int) -> bytes:
    data = file.read(count)
    if len(data) != count:
        raise SourceError(f"{path}: ends too early; download the file again")
    return data
