"""7-Scenes and tsdf-fusion: frame-NNNNNN.color, .depth.png, .pose.txt in the folder or in its data/."""

from __future__ import annotations

import re
from pathlib import Path

from client.errors import SourceError
from client.sources.datasets import intrinsics
from client.sources.datasets.folder import FolderSource, FrameFiles, require_file
from protocol.frames import CameraModel

LOOKED_FOR = "frame-NNNNNN.color.jpg|png with .depth.png and .pose.txt (7-Scenes)"
FPS = 30.0
KINECT_FOCAL_PX = 585.0
"""Focal length of the 7-Scenes depth camera (its documentation), for folders without camera-intrinsics.txt."""

_COLOR_NAME = re.compile(r"frame-(\d+)\.color\.(jpg|jpeg|png)")


def recognises(folder: Path) -> bool:
    """Whether the folder or its data/ contains frame-NNNNNN.color pictures."""
    return _frames_folder(folder) is not None


def open_folder(folder: Path) -> FolderSource:
    """The data set in `folder`, which `recognises` has accepted. Raises SourceError."""
    inner = _frames_folder(folder)
    assert inner is not None
    colors = [inner / name for name in sorted(p.name for p in inner.iterdir() if _COLOR_NAME.fullmatch(p.name))]
    with_pose = [_beside(color, ".pose.txt").is_file() for color in colors]
    if any(with_pose) and not all(with_pose):
        missing = _beside(colors[with_pose.index(False)], ".pose.txt")
        raise SourceError(f"{missing}: the pose is missing, though other frames have theirs")
    frames = tuple(_files(number, color, all(with_pose)) for number, color in enumerate(colors))
    return FolderSource(folder.resolve().name, _camera(folder, inner, colors[0]), FPS, all(with_pose), None, frames)


def _frames_folder(folder: Path) -> Path | None:
    for candidate in (folder, folder / "data"):
        if candidate.is_dir() and any(_COLOR_NAME.fullmatch(p.name) for p in candidate.iterdir()):
            return candidate
    return None


def _files(number: int, color: Path, posed: bool) -> FrameFiles:
    depth = require_file(_beside(color, ".depth.png"), "the depth picture")
    return FrameFiles(color, depth, number / FPS, _beside(color, ".pose.txt") if posed else None)


def _beside(color: Path, suffix: str) -> Path:
    return color.with_name(color.name.split(".")[0] + suffix)


def _camera(folder: Path, inner: Path, picture: Path) -> CameraModel:
    for candidate in (inner / "camera-intrinsics.txt", folder / "camera-intrinsics.txt"):
        if candidate.is_file():
            return intrinsics.from_matrix_file(candidate, picture)
    width, height = intrinsics.size_of(picture)
    return intrinsics.make(picture, width, height, KINECT_FOCAL_PX, KINECT_FOCAL_PX, width / 2, height / 2)
