"""A wall and a floor that meet in a corner as points, and a wall that goes on beyond what was seen."""

from __future__ import annotations

import numpy as np

from server.light.continuation import Continuation
from server.maths.planes import PlanePatch
from tests.scenes.analytic import Floats

WALL, FLOOR = np.array([0.0, 0.0, -1.0]), np.array([0.0, -1.0, 0.0])


def corner(count: int = 400, noise_m: float = 0.002, shift: float = 0.0) -> tuple[Floats, Floats]:
    """Points of a wall z = 2 with x and y in [0, 1], and of a floor y = 1 with z in [1, 2], and their normals."""
    rng = np.random.default_rng(3)
    wall = np.column_stack([rng.random((count, 2)) + np.array([shift, 0]), np.full(count, 2.0)])
    floor = np.column_stack([rng.random(count) + shift, np.full(count, 1.0), 1 + rng.random(count)])
    points = np.concatenate([wall, floor]) + noise_m * rng.normal(size=(2 * count, 3))
    return points, np.repeat([WALL, FLOOR], count, axis=0)


def continued_wall(offset_m: float) -> Continuation:
    """A wall x = `offset_m`, seen over 0.8 m x 0.8 m, that goes on where the volume knows nothing of it."""
    wall = PlanePatch(
        normal=np.array([1.0, 0, 0]),
        offset_m=offset_m,
        across=np.array([0.0, 0, 1]),
        along=np.array([0.0, 1, 0]),
        corner=np.zeros(2),
        empty=np.zeros((40, 40), np.bool_),
        seen=np.array([[0.0, 0], [0.8, 0.8]]),
    )
    continuation = Continuation()
    continuation.planes, continuation._boxes = [wall], [wall.box]
    return continuation
