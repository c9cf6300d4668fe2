"""Poses at times: those of a camera between the poses that a file has."""

from __future__ import annotations

from bisect import bisect_left

import cv2
import numpy as np
from numpy.typing import NDArray

Pose = NDArray[np.float64]
_SAME_S = 1e-6


class CameraPath:
    """A rigid transform over time, interpolated: position linearly, rotation at a constant speed about one axis."""

    def __init__(self, stamped: list[tuple[float, Pose]], largest_gap_s: float) -> None:
        """`stamped`: [(time_s, pose [4, 4])] in any order. `largest_gap_s`: between two that are interpolated."""
        ordered = sorted(stamped, key=lambda item: item[0])
        self._times_s = [time_s for time_s, _ in ordered]
        self._poses = [pose for _, pose in ordered]
        self._gap_s = largest_gap_s

    def at(self, time_s: float) -> Pose | None:
        """The transform at a time; None before the first, after the last, and in a larger gap."""
        after = bisect_left(self._times_s, time_s - _SAME_S)
        if after == len(self._times_s):
            return None
        if abs(self._times_s[after] - time_s) <= _SAME_S:
            return self._poses[after]
        if after == 0 or self._times_s[after] - self._times_s[after - 1] > self._gap_s:
            return None
        start_s, end_s = self._times_s[after - 1 : after + 1]
        return _between(self._poses[after - 1], self._poses[after], (time_s - start_s) / (end_s - start_s))


def _between(first: Pose, second: Pose, part: float) -> Pose:
    turn = cv2.Rodrigues(first[:3, :3].T @ second[:3, :3])[0]
    pose = np.eye(4)
    pose[:3, :3] = first[:3, :3] @ cv2.Rodrigues(part * turn)[0]
    pose[:3, 3] = (1 - part) * first[:3, 3] + part * second[:3, 3]
    return pose
