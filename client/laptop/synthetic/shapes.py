"""Solids with closed-form ray intersections: polyhedra, spheres, cylinders, capsules.

All are convex, so that none shadows itself. `intersect` takes rays of one origin (a camera), in float64; directions
need not be unit, distances are in multiples of them. `blocks` answers many rays of many points at once, and computes
in the precision of what it is given. Charts lay a grid over each smooth part of a surface, for what is baked.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from client.laptop.synthetic.charts import CapsuleChart, Chart, CylinderChart, PlaneChart, SphereChart, frame_around

Points = NDArray[np.floating]
NEAREST = 1e-6
"""Hits closer than this belong to the surface that a ray starts from."""


class Solid(Protocol):
    """What rendering and baking need of a solid."""

    @property
    def bounds(self) -> tuple[NDArray[np.float64], float] | None:
        """Centre and radius of a sphere around it; None where it surrounds everything."""

    @property
    def charts(self) -> list[Chart]:
        """One for each smooth part of the surface, numbered as `part` does."""

    def intersect(self, origin: Points, directions: Points) -> Points:
        """[n] distances to the first hit in front of `origin`, inf for a miss."""

    def part(self, points: Points) -> NDArray[np.intp]:
        """[n] which chart each point of the surface lies on."""

    def normals(self, points: Points) -> Points:
        """[n, 3] outward unit normals at points of the surface."""

    def blocks(self, points: Points, directions: Points) -> NDArray[np.bool_]:
        """[points, directions] True where the ray from the point hits; directions are unit."""

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
            _clip(near, far, offset - normal @ origin, directions @ normal)
        return np.where((near < far) & (near > NEAREST), near, np.inf)

    def part(self, points: Points) -> NDArray[np.intp]:
        return np.argmax(points @ self.plane_normals.T - self.plane_offsets, axis=1)

    def normals(self, points: Points) -> Points:
        return self.plane_normals[self.part(points)]

    def blocks(self, points: Points, directions: Points) -> NDArray[np.bool_]:
        normals, offsets = self.plane_normals.astype(points.dtype), self.plane_offsets.astype(points.dtype)
        gaps, slopes = offsets - points @ normals.T, directions @ normals.T
        # Rays that leave a plane which all points are outside of never come in: most of them, so they go first.
        may_hit = np.flatnonzero((slopes[:, (gaps < 0).all(axis=0)] < 0).all(axis=1))
        hit = np.zeros((len(points), len(directions)), bool)
        hit[:, may_hit] = _slab_hit(gaps, slopes[may_hit])
        return hit

    def contains(self, points: Points) -> NDArray[np.bool_]:
        return (points @ self.plane_normals.T < self.plane_offsets - 1e-9).all(axis=1)


@dataclass(frozen=True, eq=False)
class Sphere:
    """Centre [3] and radius, metres."""

    center: NDArray[np.float64]
    radius: float

    @property
    def bounds(self) -> tuple[NDArray[np.float64], float]:
        return self.center, self.radius

    @cached_property
    def charts(self) -> list[Chart]:
        return [SphereChart(self.center, self.radius)]

    def intersect(self, origin: Points, directions: Points) -> Points:
        return _sphere_hit(origin - self.center, directions, self.radius)

    def part(self, points: Points) -> NDArray[np.intp]:
        return np.zeros(len(points), np.intp)

    def normals(self, points: Points) -> Points:
        return (points - self.center) / self.radius

    def blocks(self, points: Points, directions: Points) -> NDArray[np.bool_]:
        return _sphere_blocks(points - self.center.astype(points.dtype), directions, self.radius)

    def contains(self, points: Points) -> NDArray[np.bool_]:
        return np.linalg.norm(points - self.center, axis=1) < self.radius - 1e-9


@dataclass(frozen=True, eq=False)
class Cylinder:
    """From `base` [3] along unit `axis` [3] for `length`, both ends closed; metres."""

    base: NDArray[np.float64]
    axis: NDArray[np.float64]
    length: float
    radius: float

    @cached_property
    def bounds(self) -> tuple[NDArray[np.float64], float]:
        return self.base + self.axis * self.length / 2, float(np.hypot(self.radius, self.length / 2))

    @cached_property
    def charts(self) -> list[Chart]:
        side_u, side_v = frame_around(self.axis)
        corners = self.radius * np.array([-side_u - side_v, side_u - side_v, side_u + side_v, side_v - side_u])
        top = self.base + self.axis * self.length
        return [
            CylinderChart(self.base, self.axis, self.length, self.radius),
            PlaneChart.around(self.base + corners, -self.axis, side_u),
            PlaneChart.around(top + corners, self.axis, side_u),
        ]

    def intersect(self, origin: Points, directions: Points) -> Points:
        start = origin - self.base
        near, far = _tube(start[None], directions, self.axis, self.radius)
        near, far = near[0], far[0]
        along, height = directions @ self.axis, start @ self.axis
        _clip(near, far, height, -along)
        _clip(near, far, self.length - height, along)
        return np.where((near < far) & (near > NEAREST), near, np.inf)

    def part(self, points: Points) -> NDArray[np.intp]:
        height = (points - self.base) @ self.axis
        outside = np.stack([self._off_axis(points) - self.radius, -height, height - self.length], axis=1)
        return np.argmax(outside, axis=1)

    def normals(self, points: Points) -> Points:
        offset = points - self.base
        radial = offset - (offset @ self.axis)[:, None] * self.axis
        radial /= np.maximum(np.linalg.norm(radial, axis=1, keepdims=True), 1e-12)
        part = self.part(points)[:, None]
        return np.where(part == 0, radial, np.where(part == 1, -self.axis, self.axis))

    def blocks(self, points: Points, directions: Points) -> NDArray[np.bool_]:
        axis = self.axis.astype(points.dtype)
        start = points - self.base.astype(points.dtype)
        near, far = _tube(start, directions, axis, self.radius)
        height, along = (start @ axis)[:, None], _no_zero(directions @ axis)
        low, high = -height / along, (self.length - height) / along
        near = np.maximum(near, np.minimum(low, high))
        far = np.minimum(far, np.maximum(low, high))
        return far > np.maximum(near, 0) + NEAREST

    def contains(self, points: Points) -> NDArray[np.bool_]:
        height = (points - self.base) @ self.axis
        return (self._off_axis(points) < self.radius - 1e-9) & (height > 1e-9) & (height < self.length - 1e-9)

    def _off_axis(self, points: Points) -> Points:
        offset = points - self.base
        return np.linalg.norm(offset - (offset @ self.axis)[:, None] * self.axis, axis=1)


@dataclass(frozen=True, eq=False)
class Capsule:
    """All points within `radius` of the segment from `start` [3] to `end` [3]; metres."""

    start: NDArray[np.float64]
    end: NDArray[np.float64]
    radius: float

    @cached_property
    def length(self) -> float:
        return float(np.linalg.norm(self.end - self.start))

    @cached_property
    def axis(self) -> NDArray[np.float64]:
        return (self.end - self.start) / self.length

    @cached_property
    def bounds(self) -> tuple[NDArray[np.float64], float]:
        return (self.start + self.end) / 2, self.length / 2 + self.radius

    @cached_property
    def charts(self) -> list[Chart]:
        return [CapsuleChart(self.start, self.axis, self.length, self.radius)]

    def intersect(self, origin: Points, directions: Points) -> Points:
        offset = origin - self.start
        near, far = _tube(offset[None], directions, self.axis, self.radius)
        near = near[0]
        height = offset @ self.axis + np.where(np.isfinite(near), near, 0) * (directions @ self.axis)
        on_side = (near < far[0]) & (near > NEAREST) & (height >= 0) & (height <= self.length)
        ends = np.minimum(
            _sphere_hit(offset, directions, self.radius), _sphere_hit(origin - self.end, directions, self.radius)
        )
        # A hit on a ball lies on the capsule only beyond the segment's ends; where it is inside, the side was hit first.
        return np.where(on_side, near, ends)

    def part(self, points: Points) -> NDArray[np.intp]:
        return np.zeros(len(points), np.intp)

    def normals(self, points: Points) -> Points:
        return (points - self._nearest(points)) / self.radius

    def blocks(self, points: Points, directions: Points) -> NDArray[np.bool_]:
        dtype = points.dtype
        start = points - self.start.astype(dtype)
        near, far = _tube(start, directions, self.axis.astype(dtype), self.radius)
        height, along = (start @ self.axis.astype(dtype))[:, None], _no_zero(directions @ self.axis.astype(dtype))
        low, high = -height / along, (dtype.type(self.length) - height) / along
        near = np.maximum(near, np.minimum(low, high))
        far = np.minimum(far, np.maximum(low, high))
        hit = far > np.maximum(near, 0) + NEAREST
        hit |= _sphere_blocks(start, directions, self.radius)
        return hit | _sphere_blocks(points - self.end.astype(dtype), directions, self.radius)

    def contains(self, points: Points) -> NDArray[np.bool_]:
        return np.linalg.norm(points - self._nearest(points), axis=1) < self.radius - 1e-9

    def _nearest(self, points: Points) -> Points:
        """[n, 3] the segment's closest points."""
        height = np.clip((points - self.start) @ self.axis, 0, self.length)
        return self.start + height[:, None] * self.axis


def _clip(near: Points, far: Points, gap: float, slope: Points) -> None:
    """Narrow the stretch [near, far] of each ray to where `slope * t <= gap`, in place."""
    t = gap / _no_zero(slope)
    entering = slope < 0
    np.maximum(near, t, out=near, where=entering)
    np.minimum(far, t, out=far, where=~entering)


def _slab_hit(gaps: Points, slopes: Points) -> NDArray[np.bool_]:
    """[points, directions] True where the stretch of the ray inside all planes is not empty.

    `gaps` [points, planes] to each plane, positive inside; `slopes` [directions, planes] how fast they close.
    """
    near = np.zeros((len(gaps), len(slopes)), gaps.dtype)
    far = np.full_like(near, np.inf)
    t = np.empty_like(near)
    for gap, slope in zip(gaps.T, slopes.T, strict=True):
        inverse = 1 / _no_zero(slope)
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


def _no_zero(slope: Points) -> Points:
    """A ray parallel to a plane meets it very far away, on the side that keeps the comparison right."""
    return np.where(np.abs(slope) < 1e-12, slope.dtype.type(1e-12), slope)


def _tube(start: Points, directions: Points, axis: Points, radius: float) -> tuple[Points, Points]:
    """[points, directions] where rays enter and leave the endless cylinder through the origin; near > far for none."""
    along = directions @ axis
    a = np.maximum((directions * directions).sum(axis=1) - along * along, 1e-12).astype(start.dtype)
    height = start @ axis
    b = start @ directions.T - height[:, None] * along
    c = ((start * start).sum(axis=1) - height * height - start.dtype.type(radius * radius))[:, None]
    root = b * b - a * c
    missed = root < 0
    root = np.sqrt(np.where(missed, 0, root))
    return np.where(missed, np.inf, (-b - root) / a), np.where(missed, -np.inf, (-b + root) / a)


def _sphere_hit(start: Points, directions: Points, radius: float) -> Points:
    a = (directions * directions).sum(axis=1)
    b = directions @ start
    root = b * b - a * (start @ start - radius * radius)
    t = (-b - np.sqrt(np.maximum(root, 0))) / a
    return np.where((root > 0) & (t > NEAREST), t, np.inf)


def _sphere_blocks(start: Points, directions: Points, radius: float) -> NDArray[np.bool_]:
    b = start @ directions.T
    c = ((start * start).sum(axis=1) - start.dtype.type(radius * radius))[:, None]
    return (b * b > c) & ((b < 0) | (c < 0))


def _shortest(edges: NDArray[np.float64]) -> int:
    """Of a rectangle's three edges from one corner, the shortest is a side, never the diagonal."""
    return int(np.linalg.norm(edges, axis=1).argmin())


def box(
    center: tuple[float, float, float], size: tuple[float, float, float], rotation: NDArray[np.float64] | None = None
) -> Polyhedron:
    """A box of edge lengths `size`, turned by `rotation` [3, 3] about its centre; metres."""
    turn = np.eye(3) if rotation is None else rotation
    normals = np.concatenate([turn.T, -turn.T])
    half = np.array(size) / 2
    offsets = np.tile(half, 2) + normals @ np.array(center)
    signs = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)])
    return Polyhedron(normals, offsets, np.array(center) + (signs * half) @ turn.T)


def wedge(
    corner: tuple[float, float, float], size: tuple[float, float, float], rotation: NDArray[np.float64] | None = None
) -> Polyhedron:
    """A ramp: a box's lower half under the plane from its low edge at -x to its high edge at +x.

    `corner` is the centre of its bottom face, about which `rotation` turns it.
    """
    turn = np.eye(3) if rotation is None else rotation
    length, height, width = size
    slope = np.hypot(length, height)
    local = np.array([[-height / slope, length / slope, 0], [1, 0, 0], [0, -1, 0], [0, 0, 1], [0, 0, -1]])
    offsets = np.array([height * length / 2 / slope, length / 2, 0, width / 2, width / 2])
    ends = [(-length / 2, 0), (length / 2, 0), (length / 2, height)]
    corners = np.array([[x, y, z] for x, y in ends for z in (-width / 2, width / 2)])
    normals = local @ turn.T
    return Polyhedron(normals, offsets + normals @ np.array(corner), np.array(corner) + corners @ turn.T)


def rotation_about(axis: str, degrees: float) -> NDArray[np.float64]:
    """[3, 3] right-handed about x, y or z."""
    c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    return {
        "x": np.array([[1, 0, 0], [0, c, -s], [0, s, c]]),
        "y": np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]]),
        "z": np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]]),
    }[axis]
