"""TUM RGB-D: rgb.txt, depth.txt and groundtruth.txt, associated by timestamps."""

from __future__ import annotations

from bisect import bisect_left
from itertools import pairwise
from pathlib import Path
from statistics import median

import numpy as np
from numpy.typing import NDArray

from client.errors import SourceError
from client.sources.datasets import intrinsics
from client.sources.datasets.folder import FolderSource, FrameFiles
from client.sources.poses import float_of, numbered_lines, read_text, read_tum
from protocol.frames import CameraModel

LOOKED_FOR = "rgb.txt with depth.txt and groundtruth.txt (TUM RGB-D)"
MAX_TIME_APART_S = 0.02
"""As in the association tool of the data set."""
DEPTH_SCALE_M = 1 / 5000
DEFAULT_FPS = 30.0

_CALIBRATIONS = {  # tables of the data set: fx fy cx cy, then k1 k2 p1 p2 k3
    "freiburg1": (517.3, 516.5, 318.6, 255.3, 0.2624, -0.9531, -0.0054, 0.0026, 1.1633),
    "freiburg2": (520.9, 521.0, 325.1, 249.7, 0.2312, -0.7849, -0.0033, -0.0001, 0.9172),
    "freiburg3": (535.4, 539.2, 320.1, 247.6, 0.0, 0.0, 0.0, 0.0, 0.0),
}


def recognises(folder: Path) -> bool:
    """Whether the folder has rgb.txt and depth.txt."""
    return (folder / "rgb.txt").is_file() and (folder / "depth.txt").is_file()


def open_folder(folder: Path) -> FolderSource:
    """The data set in `folder`, which `recognises` has accepted. Raises SourceError."""
    colors, depths = _listing(folder / "rgb.txt"), _listing(folder / "depth.txt")
    truth = folder / "groundtruth.txt"
    poses = read_tum(truth) if truth.is_file() else None
    frames = _associate(colors, depths, poses)
    if not frames:
        raise SourceError(f"{folder}: no colour, depth and pose lie within {MAX_TIME_APART_S} s of each other")
    camera = _camera(folder, frames[0].color)
    return FolderSource(folder.resolve().name, camera, _fps(frames), poses is not None, None, frames)


def _listing(path: Path) -> list[tuple[float, Path]]:
    entries = []
    for number, words in numbered_lines(path):
        if len(words) != 2:
            raise SourceError(f"{path}, line {number}: expected 'timestamp filename'")
        entries.append((float_of(words[0], f"{path}, line {number}"), path.parent / words[1]))
    return sorted(entries)


def _associate(
    colors: list[tuple[float, Path]],
    depths: list[tuple[float, Path]],
    poses: list[tuple[float, NDArray[np.float64]]] | None,
) -> tuple[FrameFiles, ...]:
    """Colour pictures with the nearest depth and pose; each depth is used once, incomplete frames are skipped."""
    depth_times = [t for t, _ in depths]
    ordered = sorted(poses or [], key=lambda stamped: stamped[0])
    pose_times = [t for t, _ in ordered]
    best: dict[int, tuple[float, int]] = {}
    for i, (time_s, _) in enumerate(colors):
        j = _nearest(depth_times, time_s)
        if j is not None and abs(depth_times[j] - time_s) < best.get(j, (np.inf, 0))[0]:
            best[j] = (abs(depth_times[j] - time_s), i)
    frames = []
    for j, (_, i) in sorted(best.items(), key=lambda item: item[1][1]):
        time_s, color = colors[i]
        k = _nearest(pose_times, time_s)
        if poses is None or k is not None:
            frames.append(FrameFiles(color, depths[j][1], time_s, None if k is None else ordered[k][1]))
    return tuple(frames)


def _nearest(times: list[float], time_s: float) -> int | None:
    at = bisect_left(times, time_s)
    near = [i for i in (at - 1, at) if 0 <= i < len(times) and abs(times[i] - time_s) <= MAX_TIME_APART_S]
    return min(near, key=lambda i: abs(times[i] - time_s), default=None)


def _camera(folder: Path, picture: Path) -> CameraModel:
    own = folder / "calibration.txt"
    if own.is_file():
        numbers = [float_of(word, str(own)) for word in read_text(own).split()]
        if len(numbers) not in (4, 9):
            raise SourceError(f"{own}: expected fx fy cx cy, then perhaps k1 k2 p1 p2 k3; found {len(numbers)} numbers")
    else:
        known = (values for key, values in _CALIBRATIONS.items() if key in folder.resolve().name)
        numbers = list(next(known, _CALIBRATIONS["freiburg1"]))
    distortion = tuple(numbers[4:]) or (0.0,) * 5
    more = {"depth_scale_m": DEPTH_SCALE_M, "distortion": distortion}
    return intrinsics.make(own, *intrinsics.size_of(picture), *numbers[:4], **more)


def _fps(frames: tuple[FrameFiles, ...]) -> float:
    steps = [b.timestamp_s - a.timestamp_s for a, b in pairwise(frames)]
    step_s = median(steps) if steps else 0.0
    return 1 / step_s if step_s > 0 else DEFAULT_FPS
