"""ARKitScenes, raw, low resolution: lowres_wide (colour) and lowres_depth (LiDAR), 256x192 pixels.

    lowres_wide/VIDEO_TIME.png, lowres_depth/VIDEO_TIME.png   depth in millimetres
    confidence/VIDEO_TIME.png                                 0, 1 or 2; may be absent
    lowres_wide_intrinsics/VIDEO_TIME.pincam                  width height fx fy cx cy
    lowres_wide.traj                                          time, axis times angle [3], translation [3], metres

A line of the .traj is camera_from_world, camera axes as OpenCV's; world +z is up. Poses are at 10 Hz: frames between
two take an interpolated one, frames before the first and after the last are left out. Times in seconds.
"""

from __future__ import annotations

import re
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from client.errors import SourceError
from client.progress import note
from client.sources.datasets.decoded import (
    DecodedSource,
    Lens,
    camera_of,
    frame_rate,
    without_unsure,
)
from client.sources.path_of_camera import CameraPath
from client.sources.pictures import read_color, read_depth, read_gray
from client.sources.poses import float_of, numbered_lines

LOOKED_FOR = "lowres_wide/ with lowres_depth/ and lowres_wide.traj (ARKitScenes)"
UP = (0.0, 0.0, 1.0)
LARGEST_GAP_S = 0.3
"""Between two poses that are interpolated; they are 0.1 s apart."""

_TIME = re.compile(r".*_(\d+(?:\.\d+)?)")


def recognises(folder: Path) -> bool:
    """Whether the folder has the low-resolution colour and depth."""
    return (folder / "lowres_wide").is_dir() and (folder / "lowres_depth").is_dir()


def open_folder(folder: Path) -> DecodedSource:
    """The capture in `folder`, which `recognises` has accepted. Raises SourceError."""
    colors, depths = _by_time(folder / "lowres_wide", ".png"), _by_time(folder / "lowres_depth", ".png")
    common = [(t, colors[t], depths[t]) for t in sorted(set(colors) & set(depths))]
    path = CameraPath(_trajectory(folder / "lowres_wide.traj"), LARGEST_GAP_S)
    placed = [(t, c, d, pose) for t, c, d in common if (pose := path.at(t)) is not None]
    if not placed:
        raise SourceError(f"{folder}: no colour, depth and pose belong together; download lowres_wide.traj again")
    if len(placed) < len(common):
        note(f"{folder.name}: {len(common) - len(placed)} of {len(common)} frames have no pose and are left out")
    times_s = tuple(t for t, *_ in placed)
    lens = _lens(folder, times_s)
    camera = camera_of(folder, lens, lens)
    read = partial(_read, [(c, d) for _, c, d, _ in placed], folder / "confidence")
    poses = tuple(pose for *_, pose in placed)
    return DecodedSource(folder.resolve().name, camera, frame_rate(times_s), UP, times_s, poses, read)


def _read(files: list[tuple[Path, Path]], unsure: Path, index: int) -> tuple[NDArray[Any], NDArray[np.uint16]]:
    color, depth = files[index]
    confidence = unsure / depth.name
    known = read_gray(confidence) if confidence.is_file() else None
    return read_color(color), without_unsure(read_depth(depth), known, confidence)


def _by_time(folder: Path, suffix: str) -> dict[float, Path]:
    found = {}
    for file in sorted(folder.iterdir()) if folder.is_dir() else ():
        match = _TIME.fullmatch(file.stem)
        if file.suffix == suffix and match:
            found[float(match[1])] = file
    if not found:
        raise SourceError(f"{folder}: holds no files VIDEO_TIME{suffix}")
    return found


def _trajectory(path: Path) -> list[tuple[float, NDArray[np.float64]]]:
    """[(time_s, world_from_camera)] of the .traj."""
    poses = []
    for number, words in numbered_lines(path):
        where = f"{path}, line {number}"
        values = [float_of(word, where) for word in words]
        if len(values) != 7 or not np.isfinite(values).all():
            raise SourceError(f"{where}: expected time, three of a rotation and three of a translation")
        camera_from_world = np.eye(4, dtype=np.float64)
        camera_from_world[:3, :3] = cv2.Rodrigues(np.array(values[1:4]))[0]
        camera_from_world[:3, 3] = values[4:7]
        poses.append((values[0], np.linalg.inv(camera_from_world).astype(np.float64)))
    return poses


def _lens(folder: Path, times_s: tuple[float, ...]) -> Lens:
    """Median over the frames: autofocus changes the focal length by about a hundredth."""
    files = _by_time(folder / "lowres_wide_intrinsics", ".pincam")
    near = np.array(sorted(files))
    chosen = {files[float(near[np.abs(near - t).argmin()])] for t in times_s}
    rows = []
    for file in sorted(chosen):
        words = [word for _, line in numbered_lines(file) for word in line]
        if len(words) != 6:
            raise SourceError(f"{file}: expected width height fx fy cx cy, found {len(words)} numbers")
        rows.append([float_of(word, str(file)) for word in words])
    width, height, fx, fy, cx, cy = np.median(rows, axis=0)
    return Lens(int(width), int(height), float(fx), float(fy), float(cx), float(cy))
