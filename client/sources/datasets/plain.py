"""A plain folder: intrinsics.json beside numbered pictures, for frames that come from no known data set.

    color/000000.jpg ...   8-bit sRGB, PNG or JPEG
    depth/000000.png ...   16 bits, 0: no measurement; the same numbers as in color/
    confidence/000000.png  optional, 8 bits, of the depth's size
    poses.txt              optional, TUM lines `timestamp tx ty tz qx qy qz qw`, world_from_camera, a line a frame
    intrinsics.json

Fields of intrinsics.json; those with a default may be left out:

    width, height, fx, fy, cx, cy   of the pictures in color/, pixels; a pixel's centre is at integer coordinates
    depth              the same six of the pictures in depth/; default: those of color, scaled to the depth's size
    color_from_depth   16 numbers, row-major, metres: from the axes of the depth lens to those of colour; default: same
    depth_scale_m      metres per unit of depth; default: 0.001
    least_confidence   depth below it is no measurement; default: 1
    camera_axes        of the poses: "opencv" (+x right, +y down, +z forward) or "opengl" (+y up, +z backward; ARKit's,
                       Blender's and WebXR's too); default: "opencv"
    up                 up direction in world axes; default: found from the scan
    fps                where there are no poses with timestamps; default: 30
"""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from client.errors import SourceError
from client.sources.datasets import intrinsics
from client.sources.datasets.decoded import (
    DEPTH_SCALE_M,
    GL_FROM_CV,
    LEAST_CONFIDENCE,
    DecodedSource,
    Lens,
    Pose,
    camera_of,
    frame_rate,
    without_unsure,
)
from client.sources.datasets.folder import COLOR_SUFFIXES, numbered
from client.sources.pictures import read_color, read_depth, read_gray
from client.sources.poses import read_tum, rigid

LOOKED_FOR = "intrinsics.json with color/ and depth/ (a plain folder)"
DEFAULT_FPS = 30.0

_LENS = ("width", "height", "fx", "fy", "cx", "cy")
_KNOWN = {*_LENS, "depth", "color_from_depth", "depth_scale_m", "least_confidence", "camera_axes", "up", "fps"}


def recognises(folder: Path) -> bool:
    """Whether the folder has an intrinsics.json."""
    return (folder / "intrinsics.json").is_file()


def open_folder(folder: Path) -> DecodedSource:
    """The capture in `folder`, which `recognises` has accepted. Raises SourceError."""
    path = folder / "intrinsics.json"
    values = intrinsics.read_json(path)
    if unknown := sorted(set(values) - _KNOWN):
        raise SourceError(f"{path}: {unknown[0]!r} is no field; there are {', '.join(sorted(_KNOWN))}")
    files = _pairs(folder)
    color = _lens(path, "the picture", values)
    depth_height, depth_width = read_depth(files[0][1]).shape
    own = values.get("depth")
    depth = color.resized(depth_width, depth_height) if own is None else _lens(path, "depth", own)
    matrix = values.get("color_from_depth")
    color_from_depth = None if matrix is None else _rigid(path, matrix)
    camera = camera_of(
        path, color, depth, color_from_depth, depth_scale_m=_number(path, values, "depth_scale_m", DEPTH_SCALE_M)
    )
    times_s, poses = _path_of_camera(folder, path, values, len(files))
    least = _number(path, values, "least_confidence", LEAST_CONFIDENCE)
    read = partial(_read, files, (color.width, color.height), int(least))
    fps = frame_rate(times_s, DEFAULT_FPS)
    return DecodedSource(folder.resolve().name, camera, fps, _up(path, values), times_s, poses, read)


def _pairs(folder: Path) -> list[tuple[Path, Path]]:
    for name in ("color", "depth"):
        if not (folder / name).is_dir():
            raise SourceError(f"{folder / name}: the folder is missing; intrinsics.json goes with color/ and depth/")
    colors, depths = numbered(folder / "color", COLOR_SUFFIXES), numbered(folder / "depth", (".png",))
    if alone := sorted(set(colors) ^ set(depths)):
        raise SourceError(f"{folder}: picture {alone[0]} is only in {'color' if alone[0] in colors else 'depth'}")
    return [(colors[number], depths[number]) for number in sorted(colors)]


def _read(
    files: list[tuple[Path, Path]], size: tuple[int, int], least: int, index: int
) -> tuple[NDArray[Any], NDArray[np.uint16]]:
    color_file, depth_file = files[index]
    color = read_color(color_file)
    if color.dtype != np.uint8 or (color.shape[1], color.shape[0]) != size:
        raise SourceError(f"{color_file}: is not of 8 bits and {size[0]}x{size[1]} pixels, as intrinsics.json says")
    confidence_file = depth_file.parent.parent / "confidence" / depth_file.name
    confidence = read_gray(confidence_file) if confidence_file.is_file() else None
    return color, without_unsure(read_depth(depth_file), confidence, confidence_file, least)


def _path_of_camera(
    folder: Path, path: Path, values: dict[str, Any], count: int
) -> tuple[tuple[float, ...], tuple[Pose, ...] | None]:
    axes = values.get("camera_axes", "opencv")
    if axes not in ("opencv", "opengl"):
        raise SourceError(f"{path}: camera_axes is {axes!r}, must be opencv or opengl")
    file = folder / "poses.txt"
    if not file.is_file():
        fps = _number(path, values, "fps", DEFAULT_FPS)
        if not 0 < fps < np.inf:
            raise SourceError(f"{path}: fps is {fps:g}, must be positive")
        return tuple(i / fps for i in range(count)), None
    lines = read_tum(file)
    if len(lines) != count:
        raise SourceError(f"{file}: has {len(lines)} poses for {count} frames; there must be a line a frame")
    flip = GL_FROM_CV if axes == "opengl" else np.eye(4)
    return tuple(time_s for time_s, _ in lines), tuple(pose @ flip for _, pose in lines)


def _lens(path: Path, of: str, values: Any) -> Lens:
    if not isinstance(values, dict) or not all(type(values.get(name)) in (int, float) for name in _LENS):
        raise SourceError(f"{path}: {of} needs the numbers {', '.join(_LENS)}")
    width, height, *rest = (values[name] for name in _LENS)
    if min(width, height) < 1 or int(width) != width or int(height) != height:
        raise SourceError(f"{path}: width and height of {of} must be whole numbers of pixels")
    return Lens(int(width), int(height), *map(float, rest))


def _rigid(path: Path, values: Any) -> NDArray[np.float64]:
    if not isinstance(values, list) or len(values) != 16 or not all(type(x) in (int, float) for x in values):
        raise SourceError(f"{path}: color_from_depth must be 16 numbers, row-major")
    return rigid(np.array(values, np.float64).reshape(4, 4), f"{path}: color_from_depth")


def _number(path: Path, values: dict[str, Any], name: str, default: float) -> float:
    value = values.get(name, default)
    if type(value) not in (int, float):
        raise SourceError(f"{path}: {name} must be a number, not {value!r}")
    return float(value)


def _up(path: Path, values: dict[str, Any]) -> tuple[float, float, float] | None:
    up = values.get("up")
    if up is None:
        return None
    if not isinstance(up, list) or len(up) != 3 or not all(type(x) in (int, float) for x in up) or not any(up):
        raise SourceError(f"{path}: up must be three numbers, not all zero")
    return float(up[0]), float(up[1]), float(up[2])
