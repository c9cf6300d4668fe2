"""Stray Scanner (iPhone and iPad with LiDAR): rgb.mp4, depth/, confidence/, odometry.csv and camera_matrix.csv.

odometry.csv has columns timestamp, frame, x, y, z, qx, qy, qz, qw: world_from_camera, camera axes as OpenCV's (the app
turns ARKit's by 180 degrees about x), world +y up, metres. camera_matrix.csv is of the video. Depth is in millimetres,
256x192, PNG or (first versions) .npy; confidence is 0, 1 or 2. Frame i of the video is depth/00000i.
"""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from client.errors import SourceError
from client.sources.datasets.decoded import DecodedSource, Lens, camera_of, frame_rate, without_unsure
from client.sources.datasets.folder import numbered
from client.sources.pictures import read_depth, read_gray
from client.sources.poses import float_of, from_quaternion, read_text
from client.sources.video_frames import VideoFrames

LOOKED_FOR = "rgb.mp4 with odometry.csv and camera_matrix.csv (Stray Scanner)"
UP = (0.0, 1.0, 0.0)
_COLUMNS = ("timestamp", "frame", "x", "y", "z", "qx", "qy", "qz", "qw")


def recognises(folder: Path) -> bool:
    """Whether the folder has the video and the odometry."""
    return (folder / "rgb.mp4").is_file() and (folder / "odometry.csv").is_file()


def open_folder(folder: Path) -> DecodedSource:
    """The capture in `folder`, which `recognises` has accepted. Raises SourceError."""
    if not (folder / "depth").is_dir():
        raise SourceError(f"{folder / 'depth'}: the folder is missing; scan with a device that has LiDAR")
    depths = numbered(folder / "depth", (".png", ".npy"))
    odometry = _odometry(folder / "odometry.csv")
    video = VideoFrames(folder / "rgb.mp4")
    frames = [number for number in sorted(odometry) if number in depths and number < len(video)]
    if not frames:
        raise SourceError(f"{folder}: no frame has colour, depth and a pose; copy the folder again")
    color = _lens(folder / "camera_matrix.csv", video)
    height, width = _depth(depths[frames[0]]).shape
    camera = camera_of(folder, color, color.resized(width, height))
    times_s = tuple(odometry[number][0] for number in frames)
    poses = tuple(odometry[number][1] for number in frames)
    read = partial(_read, video, [(number, depths[number]) for number in frames])
    return DecodedSource(folder.resolve().name, camera, frame_rate(times_s), UP, times_s, poses, read)


def _read(video: VideoFrames, frames: list[tuple[int, Path]], index: int) -> tuple[NDArray[Any], NDArray[np.uint16]]:
    number, file = frames[index]
    confidence = file.parent.parent / "confidence" / f"{file.stem}.png"
    known = read_gray(confidence) if confidence.is_file() else None
    return video[number], without_unsure(_depth(file), known, confidence)


def _depth(path: Path) -> NDArray[np.uint16]:
    if path.suffix != ".npy":
        return read_depth(path)
    try:
        depth = np.load(path, allow_pickle=False)
    except (OSError, ValueError) as error:
        raise SourceError(f"{path}: is no array of NumPy, or it is damaged") from error
    if depth.ndim != 2 or depth.dtype.kind not in "ui":
        raise SourceError(f"{path}: depth must be whole millimetres, [height, width]")
    found: NDArray[np.uint16] = depth.astype(np.uint16)
    return found


def _odometry(path: Path) -> dict[int, tuple[float, NDArray[np.float64]]]:
    """{frame: (time_s, world_from_camera)}."""
    header, *lines = [line for line in read_text(path).splitlines() if line.strip()] or [""]
    names = [name.strip() for name in header.split(",")]
    if missing := [name for name in _COLUMNS if name not in names]:
        raise SourceError(f"{path}: the first line has no column {missing[0]}; expected {', '.join(_COLUMNS)}")
    columns = [names.index(name) for name in _COLUMNS]
    poses = {}
    for number, line in enumerate(lines, 2):
        where, words = f"{path}, line {number}", line.split(",")
        if len(words) != len(names):
            raise SourceError(f"{where}: expected {len(names)} values, found {len(words)}")
        time_s, frame, *pose = (float_of(words[column].strip(), where) for column in columns)
        poses[int(frame)] = time_s, from_quaternion(np.array(pose[:3]), np.array(pose[3:]), where)
    return poses


def _lens(path: Path, video: VideoFrames) -> Lens:
    words = [word for line in read_text(path).splitlines() for word in line.split(",") if word.strip()]
    numbers = [float_of(word.strip(), str(path)) for word in words]
    if len(numbers) != 9:
        raise SourceError(f"{path}: expected a matrix of 9 numbers, found {len(numbers)}")
    return Lens(video.width, video.height, numbers[0], numbers[4], numbers[2], numbers[5])
