"""The ground-truth layout: meta.json with relative paths to depth, colour and poses.

`camera` may contain `distortion` and, if depth has its own lens, `depth`, as in `CameraModel`. `exposures` may list
exposure time times gain of each frame, null: unknown; a `linear16` set without it has constant exposure.

Virtual objects and light of the set are ground truth for evaluation, not input; `meta` keeps them.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import msgspec

from client.errors import SourceError
from client.sources.datasets import intrinsics
from client.sources.datasets.folder import COLOR_SUFFIXES, FolderSource, FrameFiles, numbered, require_file
from client.sources.poses import read_tum
from protocol.frames import NO_DISTORTION, CameraModel, DepthCamera, Distortion

LOOKED_FOR = "meta.json (ground-truth layout)"
DEFAULT_FPS = 30.0

_REQUIRED = ("camera", "depth_scale_m", "color_encoding", "color", "depth")


@dataclass(frozen=True)
class GroundTruthSource(FolderSource):
    """A folder of the ground-truth layout with the content of its meta.json."""

    folder: Path = field(default_factory=Path)
    meta: dict[str, Any] = field(default_factory=dict)

    @property
    def radiance_of_white(self) -> float:
        """Radiance of a white pixel, in the units of light.json. Raises SourceError."""
        unit = self.meta.get("radiance_at_65535", 1.0)
        if type(unit) not in (int, float) or not 0 < unit < math.inf:
            raise SourceError(f"{self.folder / 'meta.json'}: radiance_at_65535 is {unit!r}, must be a positive number")
        return float(unit)


def recognises(folder: Path) -> bool:
    """Whether the folder has a meta.json."""
    return (folder / "meta.json").is_file()


def open_folder(folder: Path) -> GroundTruthSource:
    """The data set in `folder`, which `recognises` has accepted. Raises SourceError."""
    path = folder / "meta.json"
    meta = intrinsics.read_json(path)
    absent = [key for key in _REQUIRED if key not in meta]
    if absent:
        raise SourceError(f"{path}: has no {', '.join(absent)}")
    frames = _frames(folder, meta, path)
    has_poses = frames[0].pose is not None
    camera = _camera(path, meta)
    name = folder.resolve().name
    return GroundTruthSource(name, camera, _fps(frames), has_poses, _up(path, meta), frames, folder, meta)


def _frames(folder: Path, meta: dict[str, Any], path: Path) -> tuple[FrameFiles, ...]:
    colors = numbered(_subfolder(folder, meta, "color"), COLOR_SUFFIXES)
    depths = numbered(_subfolder(folder, meta, "depth"), (".png",))
    count = meta.get("frames", len(colors))
    if not isinstance(count, int) or count < 1:
        raise SourceError(f"{path}: frames must be a positive number, not {count!r}")
    missing = [i for i in range(count) if i not in colors or i not in depths]
    if missing:
        raise SourceError(f"{path}: picture {missing[0]:06d} of {count} is missing in color or depth")
    poses = read_tum(require_file(folder / meta["poses"], "the pose file")) if "poses" in meta else None
    if poses is not None and len(poses) < count:
        raise SourceError(f"{folder / meta['poses']}: has {len(poses)} poses for {count} frames")
    times = [i / DEFAULT_FPS for i in range(count)] if poses is None else [pose[0] for pose in poses]
    exposures = _exposures(path, meta, count)
    return tuple(
        FrameFiles(colors[i], depths[i], times[i], poses[i][1] if poses else None, exposures[i]) for i in range(count)
    )


def _exposures(path: Path, meta: dict[str, Any], count: int) -> list[float | None]:
    """Exposure of each frame; the pipeline checks the values. Raises SourceError."""
    values = meta.get("exposures")
    if values is None:
        return [1.0 if meta["color_encoding"] == "linear16" else None] * count
    is_list = isinstance(values, list) and all(x is None or type(x) in (int, float) for x in values)
    if not is_list or len(values) != count:
        raise SourceError(f"{path}: exposures must be {count} numbers, one a frame, null where it is not known")
    try:
        return [None if x is None else float(x) for x in values]
    except OverflowError as error:
        raise SourceError(f"{path}: exposures has a number that no float holds") from error


def _subfolder(folder: Path, meta: dict[str, Any], key: str) -> Path:
    path = folder / str(meta[key])
    if not path.is_dir():
        raise SourceError(f"{path}: the folder that meta.json names as {key} is missing")
    return path


def _camera(path: Path, meta: dict[str, Any]) -> CameraModel:
    camera = meta["camera"]
    names = ("width", "height", "fx", "fy", "cx", "cy")
    if not isinstance(camera, dict) or not all(name in camera for name in names):
        raise SourceError(f"{path}: camera needs {', '.join(names)}")
    if meta["color_encoding"] not in ("srgb8", "linear16"):
        raise SourceError(f"{path}: color_encoding is {meta['color_encoding']!r}, must be srgb8 or linear16")
    values = [camera[name] for name in names]
    more = {"depth_scale_m": meta["depth_scale_m"], "color_encoding": meta["color_encoding"]}
    try:
        distortion = msgspec.convert(camera.get("distortion", NO_DISTORTION), Distortion)
        depth = msgspec.convert(camera.get("depth"), DepthCamera | None)
    except (msgspec.ValidationError, ValueError) as error:
        raise SourceError(f"{path}: {error}") from error
    return intrinsics.make(path, *values, **more, distortion=distortion, depth=depth)


def _up(path: Path, meta: dict[str, Any]) -> tuple[float, float, float] | None:
    up = meta.get("up")
    if up is None:
        return None
    if not isinstance(up, list) or len(up) != 3 or not all(isinstance(x, int | float) for x in up) or not any(up):
        raise SourceError(f"{path}: up must be three numbers, not all zero")
    return float(up[0]), float(up[1]), float(up[2])


def _fps(frames: tuple[FrameFiles, ...]) -> float:
    duration_s = frames[-1].timestamp_s - frames[0].timestamp_s
    return (len(frames) - 1) / duration_s if duration_s > 0 else DEFAULT_FPS
