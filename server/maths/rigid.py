"""Rigid transforms as float64 4x4 matrices named `to_from_from`."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

_NEAR_ROTATION = 1e-2


def inverse_rigid(matrix: NDArray[np.float64]) -> NDArray[np.float64]:
    """Inverse of a rigid 4x4."""
    result = np.eye(4)
    result[:3, :3] = matrix[:3, :3].T
    result[:3, 3] = -matrix[:3, :3].T @ matrix[:3, 3]
    return result


def repaired_pose(matrix: NDArray[np.float64]) -> NDArray[np.float64]:
    """The rigid transform nearest to a nearly rigid 4x4. Raises ValueError, one line, where it is none."""
    pose = np.asarray(matrix, np.float64)
    if pose.shape != (4, 4) or not np.isfinite(pose).all():
        raise ValueError("world_from_camera is not a finite 4x4 matrix")
    if np.abs(pose[3] - [0, 0, 0, 1]).max() > 1e-6:
        raise ValueError("world_from_camera's last row is not 0 0 0 1: is the matrix row-major?")
    rotation = pose[:3, :3]
    if np.abs(rotation @ rotation.T - np.eye(3)).max() > _NEAR_ROTATION or np.linalg.det(rotation) < 0:
        raise ValueError("world_from_camera's upper left 3x3 is not a rotation")
    u, _, vt = np.linalg.svd(rotation)
    result = np.eye(4)
    result[:3, :3] = u @ vt
    result[:3, 3] = pose[:3, 3]
    return result


def translation(offset: NDArray[np.float64]) -> NDArray[np.float64]:
    """4x4 that moves by `offset` [3], metres."""
    result = np.eye(4)
    result[:3, 3] = offset
    return result
