"""Open3D and Redwood: color/NNNNN.jpg, depth/NNNNN.png, an intrinsics JSON, trajectory.log."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from client.errors import SourceError
from client.sources.datasets import intrinsics
from client.sources.datasets.folder import COLOR_SUFFIXES, FolderSource, FrameFiles, is_numbered_folder, numbered
from client.sources.poses import read_log
from protocol.frames import CameraModel

LOOKED_FOR = "color/*.jpg|png with depth/*.png and camera_primesense.json (Open3D/Redwood)"
FPS = 30.0

_COLOR_FOLDERS = ("color", "image", "rgb")
_INTRINSICS = ("camera_primesense.json", "intrinsic.json", "camera_intrinsic.json")


def recognises(folder: Path) -> bool:
    """Whether the folder has subfolders with numbered colour and depth pictures."""
    return _color_folder(folder) is not None and is_numbered_folder(folder / "depth", (".png",))


def open_folder(folder: Path) -> FolderSource:
    """The data set in `folder`, which `recognises` has accepted. Raises SourceError."""
    color_folder = _color_folder(folder)
    assert color_folder is not None
    colors, depths = numbered(color_folder, COLOR_SUFFIXES), numbered(folder / "depth", (".png",))
    # Some sets number one folder from 0 and the other from 1; pictures are paired by order.
    if len(colors) != len(depths):
        raise SourceError(f"{folder}: {len(colors)} colour pictures but {len(depths)} depth pictures")
    poses = _poses(folder, len(colors))
    frames = tuple(
        FrameFiles(color, depth, i / FPS, poses.get(i))
        for i, (color, depth) in enumerate(zip(_in_order(colors), _in_order(depths), strict=True))
    )
    camera = _camera(folder, frames[0].color)
    return FolderSource(folder.resolve().name, camera, FPS, bool(poses), None, frames)


def _poses(folder: Path, count: int) -> dict[int, NDArray[np.float64]]:
    path = folder / "trajectory.log"
    if not path.is_file():
        return {}
    poses = read_log(path)
    missing = [i for i in range(count) if i not in poses]
    if missing:
        raise SourceError(f"{path}: has no pose for frame {missing[0]} of {count}")
    return poses


def _in_order(pictures: dict[int, Path]) -> list[Path]:
    return [pictures[number] for number in sorted(pictures)]


def _color_folder(folder: Path) -> Path | None:
    return next((folder / n for n in _COLOR_FOLDERS if is_numbered_folder(folder / n, COLOR_SUFFIXES)), None)


def _camera(folder: Path, picture: Path) -> CameraModel:
    for name in _INTRINSICS:
        if (folder / name).is_file():
            return intrinsics.from_open3d_json(folder / name)
    # Redwood's sets have no intrinsics file; its documentation gives PrimeSense defaults.
    width, height = intrinsics.size_of(picture)
    focal = 525.0 * width / 640
    return intrinsics.make(picture, width, height, focal, focal, (width - 1) / 2, (height - 1) / 2)
