"""Shared by the readers of data-set folders: a list of files, read frame by frame on demand."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from client.errors import SourceError
from client.sources import poses
from client.sources.pictures import read_color, read_depth
from protocol.frames import CameraModel, RgbdFrame

COLOR_SUFFIXES = (".jpg", ".jpeg", ".png")
COLOR_DTYPE = {"srgb8": np.uint8, "linear16": np.uint16}


@dataclass(frozen=True)
class FrameFiles:
    """Files of one frame."""

    color: Path
    depth: Path
    timestamp_s: float
    pose: NDArray[np.float64] | Path | None
    """world_from_camera [4, 4], or the file with its 16 numbers."""
    exposure: float | None = None
    """As in RgbdFrame."""


@dataclass(frozen=True)
class FolderSource:
    """A data set; only file names are kept in memory."""

    name: str
    camera: CameraModel
    fps: float
    has_poses: bool
    up: tuple[float, float, float] | None
    frames: tuple[FrameFiles, ...]

    def __len__(self) -> int:
        return len(self.frames)

    def __getitem__(self, index: int) -> RgbdFrame:
        files = self.frames[index]
        color, depth = read_color(files.color), read_depth(files.depth)
        self._require_match(files, color, depth)
        pose = poses.read_matrix(files.pose) if isinstance(files.pose, Path) else files.pose
        number = range(len(self))[index]
        return RgbdFrame(number, files.timestamp_s, color, depth, pose, files.exposure)

    def _require_match(self, files: FrameFiles, color: NDArray[Any], depth: NDArray[Any]) -> None:
        camera, lens = self.camera, self.camera.depth_lens
        if camera.depth is None and color.shape[:2] != depth.shape:
            raise SourceError(f"{files.color}: colour is {_size(color)} but {files.depth.name} is {_size(depth)}")
        if color.shape[:2] != (camera.height, camera.width):
            raise SourceError(f"{files.color}: {_size(color)}, but the camera is {camera.width}x{camera.height}")
        if depth.shape != (lens.height, lens.width):
            raise SourceError(f"{files.depth}: {_size(depth)}, but the depth lens is {lens.width}x{lens.height}")
        if color.dtype != COLOR_DTYPE[self.camera.color_encoding]:
            raise SourceError(f"{files.color}: {color.dtype} does not fit {self.camera.color_encoding}")


def numbered(folder: Path, suffixes: tuple[str, ...]) -> dict[int, Path]:
    """{number: file} of the pictures whose name is a number. Raises SourceError if there are none."""
    found = {int(p.stem): p for p in sorted(folder.iterdir()) if p.suffix.lower() in suffixes and p.stem.isdecimal()}
    if not found:
        raise SourceError(f"{folder}: holds no numbered pictures ({', '.join(suffixes)})")
    return found


def require_file(path: Path, why: str) -> Path:
    """`path` if it is a file. Raises SourceError with the path and `why` it is needed."""
    if not path.is_file():
        raise SourceError(f"{path}: {why} is missing")
    return path


def is_numbered_folder(folder: Path, suffixes: tuple[str, ...]) -> bool:
    """Whether `folder` contains pictures whose name is a number."""
    return folder.is_dir() and any(p.suffix.lower() in suffixes and p.stem.isdecimal() for p in folder.iterdir())


def _size(picture: NDArray[Any]) -> str:
    return f"{picture.shape[1]}x{picture.shape[0]}"
