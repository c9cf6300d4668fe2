"""Scans of all of `mitsuba_room`, of which its pictures show a part: so that all that hides light is known.

What a light from beyond the room does to an object depends on every wall; where no camera has been, a renderer can only
guess. These frames have the exact depth of all of it. Where a picture shows the same place, they have its colour, else
the mean of all pictures: the albedo of the rest is in no picture.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from client.sources.frame_source import Source
from protocol.frames import CameraModel, RgbdFrame
from server.maths.sh import spherical_fibonacci
from tests.bench.truth.exact_room import UNSEEN, ExactMeshes, Views
from tests.scenes.analytic import look_at, pixel_rays

Floats = NDArray[np.float64]

EYES_M = ((1.0, 0.4, 1.2), (0.4, 0.9, 0.5), (1.7, 0.9, 0.6))
"""World: above the table, and on either side before it."""
LOOKS = 26
"""From each eye, evenly over the sphere: the views of 50 degrees overlap."""
FRAME_S = 1 / 30
MARGIN_M = 0.05
"""Around the room in the volume: the truncated distance reaches behind walls."""


def volume_of(meshes: ExactMeshes) -> tuple[float, float, float, float, float, float]:
    """`Wishes.volume_m` that holds all of the room."""
    low, high = meshes.bounds[0] - MARGIN_M, meshes.bounds[1] + MARGIN_M
    return float(low[0]), float(low[1]), float(low[2]), float(high[0]), float(high[1]), float(high[2])


def after_whole_room(source: Source, frames: list[RgbdFrame], meshes: ExactMeshes, views: Views) -> Iterator[RgbdFrame]:
    """Scans of the whole room, then `frames` of `source`, numbered anew. views: of these frames."""
    shown = np.concatenate([frame.color.reshape(-1, 3) for frame in frames])
    mean = shown.mean(axis=0)
    poses = [_looking(eye, direction) for eye in EYES_M for direction in spherical_fibonacci(LOOKS)]
    for index, pose in enumerate(poses):
        depth_m, points = _exact_depth(source.camera, meshes, pose)
        element = views.sources(points.reshape(-1, 3)).reshape(depth_m.shape)
        color = np.where((element != UNSEEN)[..., None], shown[np.maximum(element, 0)], mean).astype(shown.dtype)
        depth = np.rint(depth_m / source.camera.depth_scale_m).astype(np.uint16)
        yield RgbdFrame(index, index * FRAME_S, color, depth, pose)
    for index, frame in enumerate(frames, start=len(poses)):
        yield replace(frame, index=index, timestamp_s=index * FRAME_S)


def _looking(eye: tuple[float, float, float], direction: Floats) -> Floats:
    """[4, 4] world from camera at `eye` that looks along unit `direction` [3]."""
    up = (0.0, -1.0, 0.0) if abs(direction[1]) < 0.9 else (0.0, 0.0, 1.0)  # any that is across
    return look_at(eye, eye + direction, up)


def _exact_depth(camera: CameraModel, meshes: ExactMeshes, pose: Floats) -> tuple[Floats, Floats]:
    """[h, w] depth in metres, 0 where nothing is met, and [h, w, 3] the points, world."""
    directions = (pixel_rays(camera) @ pose[:3, :3].T).reshape(-1, 3)
    met = meshes.cast(np.broadcast_to(pose[:3, 3], directions.shape), directions)["t_hit"].astype(np.float64)
    depth_m = np.where(np.isfinite(met), met, 0.0)  # z of a ray is 1
    shape = (camera.height, camera.width)
    return depth_m.reshape(shape), (pose[:3, 3] + directions * depth_m[:, None]).reshape(*shape, 3)
