"""Poses of visual-inertial odometry: conversion to camera axes, and interpolation at the time of a picture.

The odometry uses a gravity-aligned world and a body at the left lens, both with x forward, y left and z up. The world
here is x right, y down, z forward at the start, like a camera; `UP` is opposite to gravity.
"""

from __future__ import annotations

import threading
from bisect import bisect_left
from collections import deque

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation, Slerp

UP = (0.0, -1.0, 0.0)
FLU_FROM_CAMERA = np.array([[0, 0, 1, 0], [-1, 0, 0, 0], [0, -1, 0, 0], [0, 0, 0, 1]], np.float64)
"""point_in_flu = FLU_FROM_CAMERA * point_in_camera."""
KEPT = 256

Pose = NDArray[np.float64]


def world_from_lens(position_m: tuple[float, float, float], quaternion_xyzw: tuple[float, ...]) -> Pose:
    """[4, 4] rigid, metres, in camera axes, of a pose whose world and body have x forward, y left, z up."""
    flu = np.eye(4)
    flu[:3, :3] = Rotation.from_quat(quaternion_xyzw).as_matrix()
    flu[:3, 3] = position_m
    return FLU_FROM_CAMERA.T @ flu @ FLU_FROM_CAMERA


class PoseTrail:
    """The last poses by time; thread-safe. `gap_s`: longest interval between neighbours to interpolate."""

    def __init__(self, gap_s: float) -> None:
        self._gap_s = gap_s
        self._trail: deque[tuple[float, Pose]] = deque(maxlen=KEPT)
        self._changed = threading.Condition()

    def add(self, time_s: float, pose: Pose) -> None:
        """Append a pose; one that is not newer than the last is ignored."""
        with self._changed:
            if not self._trail or time_s > self._trail[-1][0]:
                self._trail.append((time_s, pose))
                self._changed.notify_all()

    def at(self, time_s: float, patience_s: float) -> Pose | None:
        """The pose at `time_s`, interpolated; None without a pose near that time.

        Odometry lags behind the picture: waits up to `patience_s` for a newer pose.
        """
        with self._changed:
            self._changed.wait_for(lambda: bool(self._trail) and self._trail[-1][0] >= time_s, patience_s)
            trail = list(self._trail)
        after = bisect_left(trail, time_s, key=lambda entry: entry[0])
        near = [entry for entry in trail[max(after - 1, 0) : after + 1] if abs(entry[0] - time_s) < self._gap_s]
        if len(near) == 2:
            return _between(*near[0], *near[1], time_s)
        return near[0][1] if near and abs(near[0][0] - time_s) < self._gap_s / 2 else None


def _between(first_s: float, first: Pose, last_s: float, last: Pose, time_s: float) -> Pose:
    """Linear interpolation of the position, spherical of the rotation."""
    share = (time_s - first_s) / (last_s - first_s)
    pose = np.eye(4)
    rotations = Rotation.from_matrix(np.stack([first[:3, :3], last[:3, :3]]))
    pose[:3, :3] = Slerp([0.0, 1.0], rotations)([share]).as_matrix()[0]
    pose[:3, 3] = (1 - share) * first[:3, 3] + share * last[:3, 3]
    return pose
