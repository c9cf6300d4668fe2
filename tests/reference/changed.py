"""Float64 twin of include/changed.clh: by how much virtual objects change what a point of real surface sends."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from protocol.frames import CameraModel

Floats = NDArray[np.float64]

LEAST_WEIGHT = 1e-3


def change_at(
    camera: CameraModel,
    camera_from_volume: Floats,
    positions: Floats,
    ratio: Floats,
    stride: int,
    points: Floats,
    tolerance_m: float,
    *,
    is_nearest: bool,
) -> Floats:
    """[n, 3] for `points` [n, 3]: bilinear between the samples around, or that of the nearest one.

    positions [h, w, 4], ratio [rows, cols, 4]: w = 1 where there is surface, where it is valid.
    """
    seen = points @ camera_from_volume[:3, :3].T + camera_from_volume[:3, 3]
    result = np.ones((len(points), 3))
    for i, (x, y, z) in enumerate(seen):
        if z < tolerance_m:
            continue
        col = (x / z * camera.fx + camera.cx - stride // 2) / stride
        row = (y / z * camera.fy + camera.cy - stride // 2) / stride
        if not (-0.5 <= col < ratio.shape[1] - 0.5 and -0.5 <= row < ratio.shape[0] - 0.5):
            continue
        if is_nearest:
            around = [(int(np.floor(row + 0.5)), int(np.floor(col + 0.5)), 1.0)]
        else:
            low = int(np.floor(row)), int(np.floor(col))
            around = [
                (low[0] + down, low[1] + right, abs(1 - down - (row - low[0])) * abs(1 - right - (col - low[1])))
                for down in (0, 1)
                for right in (0, 1)
            ]
        total, weights = np.zeros(3), 0.0
        for down, right, weight in around:
            here = min(max(down, 0), ratio.shape[0] - 1), min(max(right, 0), ratio.shape[1] - 1)
            there = positions[stride // 2 + here[0] * stride, stride // 2 + here[1] * stride]
            depth = camera_from_volume[2, :3] @ there[:3] + camera_from_volume[2, 3]
            is_shown = there[3] > 0 and ratio[here][3] > 0 and abs(depth - z) < tolerance_m + stride * z / camera.fx
            total += weight * is_shown * ratio[here][:3]
            weights += weight * is_shown
        if weights > LEAST_WEIGHT:
            result[i] = total / weights
    return result
