"""Record3D (iPhone and iPad): an .r3d file, which is a zip archive.

    metadata            JSON: w h (colour), dw dh (depth), K (3x3 column-major, of colour), perFrameIntrinsicCoeffs
                        ([fx, fy, cx, cy] of each frame), poses ([qx, qy, qz, qw, x, y, z]), frameTimestamps, fps
    rgbd/N.jpg          colour
    rgbd/N.depth        float32, metres, LZFSE-compressed; NaN: none
    rgbd/N.conf         uint8, 0, 1 or 2, LZFSE-compressed; absent in files of the front camera

Poses are world_from_camera with ARKit's camera axes (+y up, +z backward). Focus changes the focal length by about a
hundredth: the median over the frames is taken.
"""

from __future__ import annotations

import json
import re
import zipfile
from functools import partial
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from client.errors import SourceError
from client.sources.datasets.decoded import (
    GL_FROM_CV,
    DecodedSource,
    Lens,
    Pose,
    camera_of,
    frame_rate,
    millimetres,
    without_unsure,
)
from client.sources.pictures import decode_color
from client.sources.poses import from_quaternion

LOOKED_FOR = "a zip archive with metadata and rgbd/ (Record3D .r3d)"
DEFAULT_FPS = 60.0
KNOWN_SIZES = {256 * 192: (256, 192), 640 * 480: (640, 480)}
"""Number of pixels -> longer and shorter side, for files without dw and dh."""

_COLOR_NAME = re.compile(r"rgbd/(\d+)\.jpg")


def recognises(path: Path, head: bytes) -> bool:
    """Whether the file is a zip archive with a member `metadata`."""
    if not head.startswith(b"PK") or not zipfile.is_zipfile(path):
        return False
    with zipfile.ZipFile(path) as archive:
        return "metadata" in archive.namelist()


def open_file(path: Path) -> DecodedSource:
    """The capture in `path`, which `recognises` has accepted. Raises SourceError."""
    if find_spec("imagecodecs") is None:
        raise SourceError(
            f"{path}: depth of Record3D is LZFSE-compressed and needs imagecodecs, which is not installed: "
            "make install-import, or pip install imagecodecs"
        )
    archive = zipfile.ZipFile(path)
    members = set(archive.namelist())
    metadata = _metadata(path, archive)
    numbers = sorted(int(match[1]) for name in members if (match := _COLOR_NAME.fullmatch(name)))
    numbers = [number for number in numbers if f"rgbd/{number}.depth" in members]
    if not numbers:
        raise SourceError(f"{path}: holds no rgbd/N.jpg with rgbd/N.depth; export it again as .r3d")
    poses = _poses(path, metadata, numbers)
    times_s = _times(path, metadata, numbers)
    color = _lens(path, metadata, decode_color(_member(path, archive, f"rgbd/{numbers[0]}.jpg"), path), numbers)
    width, height = _depth_size(path, archive, metadata, numbers[0], color)
    camera = camera_of(path, color, color.resized(width, height))
    read = partial(_read, path, archive, members, (height, width), numbers)
    return DecodedSource(path.name, camera, frame_rate(times_s), None, times_s, poses, read)


def _read(
    path: Path, archive: zipfile.ZipFile, members: set[str], shape: tuple[int, int], numbers: list[int], index: int
) -> tuple[NDArray[Any], NDArray[np.uint16]]:
    stem = f"rgbd/{numbers[index]}"
    where = f"{path}: {stem}"
    color = decode_color(_member(path, archive, f"{stem}.jpg"), f"{where}.jpg")
    depth = millimetres(_array(path, archive, f"{stem}.depth", np.float32, shape))
    confidence = None
    if f"{stem}.conf" in members:
        confidence = _array(path, archive, f"{stem}.conf", np.uint8, shape)
    return color, without_unsure(depth, confidence, f"{where}.conf")


def _metadata(path: Path, archive: zipfile.ZipFile) -> dict[str, Any]:
    try:
        values = json.loads(_member(path, archive, "metadata"))
    except ValueError as error:
        raise SourceError(f"{path}: its metadata is no JSON; export it again") from error
    if not isinstance(values, dict):
        raise SourceError(f"{path}: its metadata is no JSON object; export it again")
    return values


def _member(path: Path, archive: zipfile.ZipFile, name: str) -> bytes:
    try:
        return archive.read(name)
    except (KeyError, OSError, zipfile.BadZipFile) as error:
        raise SourceError(f"{path}: {name} is missing or damaged; copy the file again") from error


def _decompressed(path: Path, archive: zipfile.ZipFile, name: str) -> bytes:
    import imagecodecs

    try:
        return bytes(imagecodecs.lzfse_decode(_member(path, archive, name)))
    except (RuntimeError, ValueError) as error:
        raise SourceError(f"{path}: {name} cannot be decompressed (LZFSE); copy the file again") from error


def _array(path: Path, archive: zipfile.ZipFile, name: str, dtype: type, shape: tuple[int, int]) -> NDArray[Any]:
    data = _decompressed(path, archive, name)
    if len(data) != np.dtype(dtype).itemsize * shape[0] * shape[1]:
        raise SourceError(f"{path}: {name} has {len(data)} bytes, which is not {shape[1]}x{shape[0]} pixels")
    return np.frombuffer(data, dtype).reshape(shape)


def _numbers(path: Path, metadata: dict[str, Any], key: str, columns: int) -> NDArray[np.float64] | None:
    """[n, columns] of a list of the metadata; None if it is absent or empty."""
    rows = metadata.get(key)
    if not rows:
        return None
    try:
        found = np.array(rows, np.float64).reshape(-1, columns)
    except (TypeError, ValueError) as error:
        raise SourceError(f"{path}: {key} of its metadata must be rows of {columns} numbers") from error
    if not np.isfinite(found).all():
        raise SourceError(f"{path}: {key} of its metadata has NaN or infinity")
    return found


def _poses(path: Path, metadata: dict[str, Any], numbers: list[int]) -> tuple[Pose, ...] | None:
    rows = _numbers(path, metadata, "poses", 7)
    if rows is None:
        return None
    if numbers[-1] >= len(rows):
        raise SourceError(f"{path}: has no pose for frame {numbers[-1]}, only {len(rows)} in all; export it again")
    return tuple(from_quaternion(rows[i, 4:], rows[i, :4], f"{path}: pose {i}") @ GL_FROM_CV for i in numbers)


def _times(path: Path, metadata: dict[str, Any], numbers: list[int]) -> tuple[float, ...]:
    stamps = _numbers(path, metadata, "frameTimestamps", 1)
    if stamps is not None and numbers[-1] < len(stamps):
        return tuple(float(stamps[i, 0]) for i in numbers)
    fps = metadata.get("fps", DEFAULT_FPS)
    if type(fps) not in (int, float) or not 0 < fps < np.inf:
        raise SourceError(f"{path}: fps of its metadata is {fps!r}, must be a positive number")
    return tuple(i / fps for i in numbers)


def _lens(path: Path, metadata: dict[str, Any], picture: NDArray[Any], numbers: list[int]) -> Lens:
    height, width = picture.shape[:2]
    each = _numbers(path, metadata, "perFrameIntrinsicCoeffs", 4)
    if each is not None and numbers[-1] < len(each):
        fx, fy, cx, cy = np.median(each[numbers], axis=0)
    elif (matrix := _numbers(path, metadata, "K", 9)) is not None:
        fx, fy, cx, cy = matrix[0, [0, 4, 6, 7]]
    else:
        raise SourceError(f"{path}: its metadata has no K and no perFrameIntrinsicCoeffs; export it again")
    given_width, given_height = metadata.get("w", width), metadata.get("h", height)
    if not (type(given_width) is int and type(given_height) is int and min(given_width, given_height) > 0):
        raise SourceError(f"{path}: w and h of its metadata must be numbers of pixels")
    return Lens(given_width, given_height, float(fx), float(fy), float(cx), float(cy)).resized(width, height)


def _depth_size(
    path: Path, archive: zipfile.ZipFile, metadata: dict[str, Any], number: int, color: Lens
) -> tuple[int, int]:
    """(width, height) of depth."""
    width, height = metadata.get("dw"), metadata.get("dh")
    if type(width) is int and type(height) is int:
        return width, height
    count = len(_decompressed(path, archive, f"rgbd/{number}.depth")) // 4
    if count not in KNOWN_SIZES:
        raise SourceError(f"{path}: its metadata has no dw and dh, and {count} pixels of depth are of no known size")
    longer, shorter = KNOWN_SIZES[count]
    return (longer, shorter) if color.width > color.height else (shorter, longer)
