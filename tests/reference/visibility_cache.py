"""Float64 twin of cl_kernels/include/visibility_cache.clh."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from protocol.frames import CameraModel

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Layer:
    """What one earlier frame left."""

    camera_from_volume: Floats
    points: Floats
    """[rows, cols, 4] w = 1 where visibility may be taken from."""
    normals: Floats
    """[rows, cols, 4]."""
    traced: NDArray[np.bool_]
    """[rows, cols, k] subsets."""
    set: NDArray[np.integer]
    """[rows, cols] along which they were traced."""
    blocked: NDArray[np.bool_]
    """[rows, cols, count] directions, of the sample's own set."""


def find_cached(
    layers: list[Layer],
    camera: CameraModel,
    stride: int,
    points: Floats,
    normals: Floats,
    voxel_m: float,
    wanted: NDArray[np.bool_],
) -> tuple[NDArray[np.bool_], NDArray[np.int64], NDArray[np.bool_]]:
    """What `layers`, newest first, know of subsets `wanted` [n, k] at points and unit normals [n, 3].

    -> subsets found [n, k], the set that each was traced along [n, k] (-1 where not found), blocked [n, count].
    """
    k = wanted.shape[1]
    found, sets = np.zeros_like(wanted), np.full(wanted.shape, -1)
    blocked = np.zeros((len(points), layers[0].blocked.shape[2]), bool)
    subset_of = np.arange(blocked.shape[1]) % k
    for layer in layers:
        rows, cols = layer.traced.shape[:2]
        seen = points @ layer.camera_from_volume[:3, :3].T + layer.camera_from_volume[:3, 3]
        pixel = seen[:, :2] / seen[:, 2:] * (camera.fx, camera.fy) + (camera.cx, camera.cy)
        cell = np.floor((pixel - stride // 2) / stride + 0.5)
        inside = (seen[:, 2] > 0) & (cell >= 0).all(1) & (cell < (cols, rows)).all(1)
        col, row = np.where(inside[:, None], cell, 0).astype(int).T
        there, facing = layer.points[row, col], (layer.normals[row, col, :3] * normals).sum(1)
        offset = there[:, :3] - points
        off_plane = np.abs((offset * normals).sum(1))
        same = (there[:, 3] > 0) & (facing >= 0.9) & (off_plane <= voxel_m + 0.3 * np.linalg.norm(offset, axis=1))
        new = layer.traced[row, col] & wanted & ~found & (inside & same)[:, None]
        blocked |= layer.blocked[row, col] & new[:, subset_of]
        sets = np.where(new, layer.set[row, col][:, None], sets)
        found |= new
    return found, sets, blocked
