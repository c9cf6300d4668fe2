"""Relocalisation: searches keyframes for the most similar image (Klein and Murray 2008, sec. 3) and registers the
measured depth with the surface seen from there."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from protocol.frames import CameraModel, RgbdFrame
from server.maths.registration import angle_between, distance_between
from server.opencl.buffers import BufferGroup, StageBuffers
from server.opencl.engine import Engine
from server.tracking.track import Pyramid, Registration, ViewBuffers, register, view_model
from server.volume.raycast import SurfaceBuffers, raycast
from server.volume.volume import Volume

THUMB = (40, 30)
GREATEST_COUNT = 200
NEW_DISTANCE_M, NEW_ANGLE_RAD = 0.2, np.radians(12.0)
"""A view this far from every keyframe becomes a keyframe."""
_CANDIDATES = 3
_LEAST_SHARE, _LEAST_OVERLAP, _GREATEST_DEVIATION_M = 0.6, 0.2, 0.012
_SAME_VIEW_M, _SAME_VIEW_RAD = 0.5, np.radians(30.0)
"""A keyframe farther than this from the registered pose is not the same view."""


class _Buffers(StageBuffers):
    surface = BufferGroup(SurfaceBuffers)
    view = BufferGroup(ViewBuffers)


@dataclass(frozen=True)
class Thumbnail:
    """A small image for comparison with all keyframes."""

    intensity: NDArray[np.float32]
    """[30, 40] normalised to mean 0 and deviation 1."""
    log_depth: NDArray[np.float32]
    """[30, 40] logarithm of metres, 0 = none."""
    is_deep: NDArray[np.bool_]
    """[30, 40] whether there is depth."""


@dataclass(frozen=True)
class Keyframe:
    """A stored view."""

    thumbnail: Thumbnail
    volume_from_camera: NDArray[np.float64]


def thumbnail(frame: RgbdFrame, depth_m: NDArray[np.float32]) -> Thumbnail:
    """Thumbnail of a frame's colour and of its rectified depth (any size, metres, 0 = none)."""
    grey = frame.color[::4, ::4].astype(np.float32).mean(axis=2)
    small = cv2.resize(np.sqrt(grey), THUMB, interpolation=cv2.INTER_AREA)
    deviation = float(small.std())
    intensity = (small - small.mean()) / deviation if deviation > 1e-6 else np.zeros_like(small)
    count = cv2.resize((depth_m > 0).astype(np.float32), THUMB, interpolation=cv2.INTER_AREA)
    total = cv2.resize(depth_m, THUMB, interpolation=cv2.INTER_AREA)
    is_deep = count > 0.5
    log_depth = np.log(np.where(is_deep, total / np.maximum(count, 1e-6), 1.0))
    return Thumbnail(intensity.astype(np.float32), log_depth.astype(np.float32), is_deep)


def dissimilarity(a: Thumbnail, b: Thumbnail) -> float:
    """Mean difference of intensity plus twice that of log depth; depth in only one counts as a factor of two."""
    both, one = a.is_deep & b.is_deep, a.is_deep ^ b.is_deep
    depth = np.abs(a.log_depth - b.log_depth)[both].sum() + np.log(2) * one.sum()
    return float(np.abs(a.intensity - b.intensity).mean() + 2 * depth / max(int((both | one).sum()), 1))


class Keyframes:
    """Stored views of a volume for relocalisation."""

    def __init__(self) -> None:
        self._kept: list[Keyframe] = []

    def __len__(self) -> int:
        return len(self._kept)

    def kept(self) -> list[Keyframe]:
        """All keyframes, oldest first."""
        return list(self._kept)

    def is_new(self, volume_from_camera: NDArray[np.float64]) -> bool:
        """Whether a view is far enough from all keyframes to become one."""
        return not any(is_near(kept.volume_from_camera, volume_from_camera) for kept in self._kept)

    def add(self, seen: Thumbnail, volume_from_camera: NDArray[np.float64]) -> None:
        """Keep a view; beyond GREATEST_COUNT, one of the two nearest to each other is removed."""
        self._kept.append(Keyframe(seen, volume_from_camera))
        if len(self._kept) > GREATEST_COUNT:
            del self._kept[self._most_crowded()]

    def most_similar(self, seen: Thumbnail, count: int) -> list[NDArray[np.float64]]:
        """volume_from_camera of the `count` keyframes most similar to `seen`, the most similar first."""
        ranked = sorted(self._kept, key=lambda kept: dissimilarity(kept.thumbnail, seen))
        return [kept.volume_from_camera for kept in ranked[:count]]

    def _most_crowded(self) -> int:
        poses = np.array([kept.volume_from_camera[:3, [2, 3]].ravel() for kept in self._kept])
        apart = np.linalg.norm(poses[:, None] - poses, axis=-1) + np.diag(np.full(len(poses), np.inf))
        return int(apart.min(axis=1).argmin())


def relocalize(
    engine: Engine,
    camera: CameraModel,
    volume: Volume,
    pyramid: Pyramid,
    poses: list[NDArray[np.float64]],
) -> Registration | None:
    """Register the depth with the volume near one of the `poses` (volume_from_camera); None without a certain result.

    A result is verified against the surface seen from its own pose.
    """
    for pose in poses[:_CANDIDATES]:
        found = fit_near(engine, camera, volume, pyramid, pose)
        if found is None or not is_near(found.volume_from_camera, pose, _SAME_VIEW_M, _SAME_VIEW_RAD):
            continue
        verified = fit_near(engine, camera, volume, pyramid, found.volume_from_camera)
        if verified is not None and is_certain(verified):
            return verified
    return None


def fit_near(
    engine: Engine,
    camera: CameraModel,
    volume: Volume,
    pyramid: Pyramid,
    pose: NDArray[np.float64],
) -> Registration | None:
    """Register the depth with the surface seen from `pose` (volume_from_camera); None without overlap."""
    volume.bring_back(camera, pose)
    buffers = engine.buffers(_Buffers)
    seen = raycast(engine, camera, pose, volume, buffers.surface)
    view = view_model(engine, camera, pose, seen, buffers.view)
    return register(engine, camera, view, pyramid, pose, 0.25 * volume.voxel_m)


def is_certain(found: Registration) -> bool:
    """Whether a registration fits well, overlaps enough and fixes all motions."""
    fits = found.share > _LEAST_SHARE and found.overlap > _LEAST_OVERLAP and found.deviation_m < _GREATEST_DEVIATION_M
    return fits and not len(found.free)


def is_near(
    a: NDArray[np.float64],
    b: NDArray[np.float64],
    distance_m: float = NEW_DISTANCE_M,
    angle_rad: float = NEW_ANGLE_RAD,
) -> bool:
    """Whether two poses are nearer than both limits."""
    return distance_between(a, b) < distance_m and angle_between(a, b) < angle_rad
