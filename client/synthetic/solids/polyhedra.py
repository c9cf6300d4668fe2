"""Interface of solids, and convex polyhedra.

All solids except those of carved.py are convex, so they do not shadow themselves. `intersect` takes float64 rays of one
origin (a camera); directions need not be unit, distances are multiples of them. `blocks` tests many directions of many
points at once, in the precision of its arguments. Charts parametrise each smooth part of a surface, for shadow grids.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from client.synthetic.solids.charts import Chart, PlaneChart

Points = NDArray[np.floating]
NEAREST = 1e-6
"""Closer hits are the surface that the ray starts from."""


class Solid(Protocol):
    """Interface of solids for rendering and shadows."""

    @property
    def bounds(self) -> tuple[NDArray[np.float64], float] | None:
        """Centre and radius of a bounding sphere; None: it encloses the scene."""

    @property
    def charts(self) -> list[Chart]:
        """One chart per smooth part of the surface, in the order of `part`."""

    def intersect(self, origin: Points, directions: Points) -> Points:
        """[n] distances to the first hit in front of `origin` [3]; inf: no hit."""

    def part(self, points: Points) -> NDArray[np.intp]:
        """[n] index of the chart of each surface point."""

    def normals(self, points: Points) -> Points:
        """[n, 3] outward unit normals at points of the surface."""

    def blocks(self, points: Points, directions: Points) -> NDArray[np.bool_]:
        """[points, directions] True where the ray hits; directions are unit."""

    def contains(self, points: Points) -> NDArray[np.bool_]:
        """[n] True strictly inside."""


@dataclass(frozen=True, eq=False)
class Polyhedron:
    """The points with `plane_normals @ point <= plane_offsets`."""

    plane_normals: NDArray[np.float64]
    """[k, 3] unit, outward."""
    plane_offsets: NDArray[np.float64]
    """[k] metres."""
    corners: NDArray[np.float64]
    """[c, 3]; each lies on three or more planes."""

    @cached_property
    def bounds(self) -> tuple[NDArray[np.float64], float]:
        center = (self.corners.min(axis=0) + self.corners.max(axis=0)) / 2
        return center, float(np.linalg.norm(self.corners - center, axis=1).max())

    @cached_property
    def charts(self) -> list[Chart]:
        return [self._chart(n, h) for n, h in zip(self.plane_normals, self.plane_offsets, strict=True)]

    def _chart(self, normal: NDArray[np.float64], offset: float) -> Chart:
        face = self.corners[np.abs(self.corners @ normal - offset) < 1e-9]
        edges = face - face[0]
        axis_u = edges[np.linalg.norm(edges, axis=1).argmax()] if len(face) != 4 else edges[1:][_shortest(edges[1:])]
        return PlaneChart.around(face, normal, axis_u / np.linalg.norm(axis_u))

    def intersect(self, origin: Points, directions: Points) -> Points:
        near, far = np.full(len(directions), -np.inf), np.full(len(directions), np.inf)
        for normal, offset in zip(self.plane_normals, self.plane_offsets, strict=True):
            clip(near, far, offset - normal @ origin, directions @ normal)
        return np.where((near < far) & (near > NEAREST), near, np.inf)

    def part(self, points: Points) -> NDArray[np.intp]:
        planes: NDArray[np.intp] = np.argmax(points @ self.plane_normals.T - self.plane_offsets, axis=1)
        return planes

    def normals(self, points: Points) -> Points:
        return self.plane_normals[self.part(points)]

    def blocks(self, points: Points, directions: Points) -> NDArray[np.bool_]:
        normals, offsets = self.plane_normals.astype(points.dtype), self.plane_offsets.astype(points.dtype)
        gaps, slopes = offsets - points @ normals.T, directions @ normals.T
        # If all points are outside a plane, rays away from it cannot hit. This excludes most rays.
        may_hit = np.flatnonzero((slopes[:, (gaps < 0).all(axis=0)] < 0).all(axis=1))
        hit = np.zeros((len(points), len(directions)), bool)
        hit[:, may_hit] = _slab_hit(gaps, slopes[may_hit])
        return hit

    def span(self, points: Points, directions: Points) -> tuple[Points, Points]:
        """[points, directions] distances of entry and exit, also behind the point; near >= far: no hit."""
        normals, offsets = self.plane_normals.astype(points.dtype), self.plane_offsets.astype(points.dtype)
        near = np.full((len(points), len(directions)), -np.inf, points.dtype)
        far = np.full_like(near, np.inf)
        for gap, slope in zip((offsets - points @ normals.T).T, (directions @ normals.T).T, strict=True):
            closing = no_zero(slope)
            t = gap[:, None] / closing
            np.maximum(near, t, out=near, where=closing < 0)
            np.minimum(far, t, out=far, where=closing > 0)
        return near, far

    def contains(self, points: Points) -> NDArray[np.bool_]:
        inside: NDArray[np.bool_] = np.all(points @ self.plane_normals.T < self.plane_offsets - 1e-9, axis=1)
        return inside


def clip(near: Points, far: Points, gap: float | Points, slope: Points) -> None:
    """Clip the interval [near, far] of each ray to `slope * t <= gap`, in place."""
    t = gap / no_zero(slope)
    entering = slope < 0
    np.maximum(near, t, out=near, where=entering)
    np.minimum(far, t, out=far, where=~entering)


def _slab_hit(gaps: Points, slopes: Points) -> NDArray[np.bool_]:
    """[points, directions] True where the interval of the ray inside all planes is not empty.

    `gaps` [points, planes]: distance to each plane, positive inside; `slopes` [directions, planes]: its decrease.
    """
    near = np.zeros((len(gaps), len(slopes)), gaps.dtype)
    far = np.full_like(near, np.inf)
    t = np.empty_like(near)
    for gap, slope in zip(gaps.T, slopes.T, strict=True):
        inverse = 1 / no_zero(slope)
        if (slope < 0).any() and (gap < 0).any():
            inward = slope < 0
            np.multiply(gap[:, None], np.where(inward, inverse, 0), out=t)
            t += np.where(inward, 0, -np.inf).astype(t.dtype)
            np.maximum(near, t, out=near)
        if (slope >= 0).any():
            outward = slope >= 0
            np.multiply(gap[:, None], np.where(outward, inverse, 0), out=t)
            t += np.where(outward, 0, np.inf).astype(t.dtype)
            np.minimum(far, t, out=far)
    return far > near + NEAREST


def no_zero(slope: Points) -> Points:
    """`slope` without zeros: a ray parallel to a plane hits it very far away instead of never."""
    return np.where(np.abs(slope) < 1e-12, slope.dtype.type(1e-12), slope)


def _shortest(edges: NDArray[np.float64]) -> int:
    """Index of the shortest edge from one corner of a rectangle, which is never the diagonal."""
    return int(np.linalg.norm(edges, axis=1).argmin())


def box(
    center: tuple[float, float, float], size: tuple[float, float, float], rotation: NDArray[np.float64] | None = None
) -> Polyhedron:
    """A box with edge lengths `size`, rotated by `rotation` [3, 3] about its centre; metres."""
    matrix = np.eye(3) if rotation is None else rotation
    normals = np.concatenate([matrix.T, -matrix.T])
    half = np.array(size) / 2
    offsets = np.tile(half, 2) + normals @ np.array(center)
    signs = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)])
    return Polyhedron(normals, offsets, np.array(center) + (signs * half) @ matrix.T)


def wedge(
    corner: tuple[float, float, float], size: tuple[float, float, float], rotation: NDArray[np.float64] | None = None
) -> Polyhedron:
    """A ramp that rises from -x to +x. `corner` is the centre of its bottom face and of the `rotation`; metres."""
    matrix = np.eye(3) if rotation is None else rotation
    length, height, width = size
    slope = np.hypot(length, height)
    local = np.array([[-height / slope, length / slope, 0], [1, 0, 0], [0, -1, 0], [0, 0, 1], [0, 0, -1]])
    offsets = np.array([height * length / 2 / slope, length / 2, 0, width / 2, width / 2])
    ends = [(-length / 2, 0), (length / 2, 0), (length / 2, height)]
    corners = np.array([[x, y, z] for x, y in ends for z in (-width / 2, width / 2)])
    normals = local @ matrix.T
    return Polyhedron(normals, offsets + normals @ np.array(corner), np.array(corner) + corners @ matrix.T)


def rotation_about(axis: str, degrees: float) -> NDArray[np.float64]:
    """[3, 3] right-handed rotation about x, y or z."""
    c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    return {
        "x": np.array([[1, 0, 0], [0, c, -s], [0, s, c]]),
        "y": np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]]),
        "z": np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]]),
    }[axis]
