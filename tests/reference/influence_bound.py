"""Float64 twin of influence_bound.cl: what objects in balls can change of a sample's shading at most."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

LEAST_SHADING = 0.02
Floats = NDArray[np.float64]


def bound(
    position: Floats,
    normal: Floats,
    directions: Floats,
    arriving: Floats,
    free: NDArray[np.bool_],
    without: Floats,
    mean: Floats,
    openness: float,
    balls: Floats,
    sent: Floats,
    real_sent: Floats,
    unseen: Floats,
) -> Floats:
    """[3] as bound_samples says. directions [n, 3] of even solid angle; arriving [n, 3] from them; free [n];
    without [3]: R; mean [3] of the light; balls [m, 4]."""
    share = np.maximum(directions @ normal, 0.0) * 4 / len(directions)
    meets = np.zeros(len(directions), bool)
    for x, y, z, radius in balls:
        offset = np.array([x, y, z]) - position
        distance = np.linalg.norm(offset)
        # A ray meets a ball where it starts inside, or passes the middle by less than the radius, ahead.
        along = directions @ offset
        passes = np.linalg.norm(offset - along[:, None] * directions, axis=1)
        meets |= (distance <= radius) | ((passes <= radius) & (along > 0))
    most = np.where(free[:, None], np.maximum(arriving, unseen), np.maximum(real_sent, unseen))
    counted = (meets * share)[:, None]
    shading = np.maximum(without, LEAST_SHADING * mean + 1e-9)
    change = ((counted * np.maximum(most, sent)).sum(axis=0) / shading).max()
    by_sent = (counted.sum() * sent / shading).max()
    return np.array([change, by_sent, np.clip(1 - openness, 0, 1) * (real_sent / shading).max()])


def dims(direction: Floats, half_angle_rad: float, ball: Floats, position: Floats, normal: Floats) -> bool:
    """Whether one of a disc's directions meets the ball: the disc is a cone, sampled along its rim and inside."""
    side = np.cross(direction, np.eye(3)[np.abs(direction).argmin()])
    side /= np.linalg.norm(side)
    turn, out = np.meshgrid(np.linspace(0, 2 * np.pi, 96), np.linspace(0, half_angle_rad, 24))
    around = np.cos(turn)[..., None] * side + np.sin(turn)[..., None] * np.cross(direction, side)
    rays = (np.cos(out)[..., None] * direction + np.sin(out)[..., None] * around).reshape(-1, 3)
    offset = ball[:3] - position
    along = rays @ offset
    passes = np.linalg.norm(offset - along[:, None] * rays, axis=1)
    return bool(((passes <= ball[3]) & (along > 0) & (rays @ normal > 0)).any())
