"""A room: a box seen from inside, with rectangular openings for light."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from client.synthetic.solids.charts import Chart, PlaneChart
from client.synthetic.solids.polyhedra import NEAREST, Points

WALLS = ((0, -1), (0, 1), (1, -1), (1, 1), (2, -1), (2, 1))
"""(axis, side) of each wall; its index is the number of the wall."""


@dataclass(frozen=True)
class Opening:
    """A rectangle in a wall, in world coordinates of the two other axes in order."""

    wall: int
    low: tuple[float, float]
    high: tuple[float, float]


@dataclass(frozen=True, eq=False)
class Shell:
    """The inside of the box from `low` [3] to `high` [3]; it contains the scene and the camera."""

    low: NDArray[np.float64]
    high: NDArray[np.float64]
    openings: tuple[Opening, ...]

    bounds = None

    @cached_property
    def charts(self) -> list[Chart]:
        return [self._chart(axis, side) for axis, side in WALLS]

    def _chart(self, axis: int, side: int) -> Chart:
        others = [a for a in range(3) if a != axis]
        corners = np.empty((4, 3))
        corners[:, axis] = self.high[axis] if side > 0 else self.low[axis]
        corners[:, others[0]] = self.low[others[0]], self.high[others[0]], self.low[others[0]], self.high[others[0]]
        corners[:, others[1]] = self.low[others[1]], self.low[others[1]], self.high[others[1]], self.high[others[1]]
        return PlaneChart.around(corners, -side * np.eye(3)[axis], np.eye(3)[others[0]])

    def intersect(self, origin: Points, directions: Points) -> Points:
        t, wall = self._exit(origin[None], directions)
        t, wall = t[0], wall[0]
        points = origin + t[:, None] * directions
        for opening in self.openings:
            axis, _ = WALLS[opening.wall]
            u, v = (points[:, a] for a in range(3) if a != axis)
            t = np.where((wall == opening.wall) & _within(opening, u, v), np.inf, t)
        return t

    def part(self, points: Points) -> NDArray[np.intp]:
        outside = [points[:, a] - self.high[a] if side > 0 else self.low[a] - points[:, a] for a, side in WALLS]
        walls: NDArray[np.intp] = np.argmax(np.stack(outside, axis=1), axis=1)
        return walls

    def normals(self, points: Points) -> Points:
        inward = np.array([-side * np.eye(3)[axis] for axis, side in WALLS])
        return inward[self.part(points)]

    def blocks(self, points: Points, directions: Points) -> NDArray[np.bool_]:
        blocked = np.ones((len(points), len(directions)), bool)
        for opening in self.openings:
            axis, side = WALLS[opening.wall]
            towards = np.flatnonzero(directions[:, axis] * side > NEAREST)
            depth = (self.high[axis] if side > 0 else self.low[axis]).astype(points.dtype) - points[:, axis, None]
            slope = directions[towards]
            # The room is convex: a ray through the opening meets no other wall before.
            u, v = (points[:, a, None] + depth * (slope[:, a] / slope[:, axis]) for a in range(3) if a != axis)
            blocked[:, towards] &= ~_within(opening, u, v)
        return blocked

    def contains(self, points: Points) -> NDArray[np.bool_]:
        """True outside the room, which is invisible."""
        inside: NDArray[np.bool_] = np.all((points > self.low) & (points < self.high), axis=1)
        return ~inside

    def absent(self, points: Points) -> NDArray[np.bool_]:
        """[n] True where a wall point lies in an opening."""
        part = self.part(points)
        inside = np.zeros(len(points), bool)
        for opening in self.openings:
            u, v = (points[:, a] for a in range(3) if a != WALLS[opening.wall][0])
            inside |= (part == opening.wall) & _within(opening, u, v)
        return inside

    def _exit(self, points: Points, directions: Points) -> tuple[Points, NDArray[np.intp]]:
        """[points, directions] distance to the wall that each ray hits, and the number of the wall."""
        distances = np.stack([self._distance(points, directions, axis) for axis in range(3)])
        axis = distances.argmin(axis=0)
        side = np.where(directions > 0, 1, 0)
        wall = 2 * axis + np.take_along_axis(side, axis.T, axis=1).T
        return distances.min(axis=0), wall

    def _distance(self, points: Points, directions: Points, axis: int) -> Points:
        slope = directions[:, axis]
        slope = np.where(np.abs(slope) < 1e-9, np.copysign(slope.dtype.type(1e-9), slope), slope)
        bound = np.where(slope > 0, self.high[axis], self.low[axis]).astype(slope.dtype)
        distance: Points = (bound - points[:, axis, None]) / slope
        return distance


def _within(opening: Opening, u: Points, v: Points) -> NDArray[np.bool_]:
    return (u > opening.low[0]) & (u < opening.high[0]) & (v > opening.low[1]) & (v < opening.high[1])
