"""Round solids: spheres, cylinders, capsules."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from client.synthetic.solids.charts import CapsuleChart, Chart, CylinderChart, PlaneChart, SphereChart, frame_around
from client.synthetic.solids.polyhedra import NEAREST, Points, clip, no_zero


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
        inside: NDArray[np.bool_] = np.linalg.norm(points - self.center, axis=1) < self.radius - 1e-9
        return inside


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
        clip(near, far, height, -along)
        clip(near, far, self.length - height, along)
        return np.where((near < far) & (near > NEAREST), near, np.inf)

    def part(self, points: Points) -> NDArray[np.intp]:
        height = (points - self.base) @ self.axis
        outside = np.stack([self._off_axis(points) - self.radius, -height, height - self.length], axis=1)
        charts: NDArray[np.intp] = np.argmax(outside, axis=1)
        return charts

    def normals(self, points: Points) -> Points:
        offset = points - self.base
        radial = offset - (offset @ self.axis)[:, None] * self.axis
        radial /= np.maximum(np.linalg.norm(radial, axis=1, keepdims=True), 1e-12)
        part = self.part(points)[:, None]
        return np.where(part == 0, radial, np.where(part == 1, -self.axis, self.axis))

    def span(self, points: Points, directions: Points) -> tuple[Points, Points]:
        """[points, directions] distances of entry and exit, also behind the point; near >= far: no hit."""
        axis = self.axis.astype(points.dtype)
        start = points - self.base.astype(points.dtype)
        near, far = _tube(start, directions, axis, self.radius)
        height, along = (start @ axis)[:, None], no_zero(directions @ axis)
        low, high = -height / along, (self.length - height) / along
        return np.maximum(near, np.minimum(low, high)), np.minimum(far, np.maximum(low, high))

    def blocks(self, points: Points, directions: Points) -> NDArray[np.bool_]:
        near, far = self.span(points, directions)
        return far > np.maximum(near, 0) + NEAREST

    def contains(self, points: Points) -> NDArray[np.bool_]:
        return self.outside_m(points) < -1e-9

    def outside_m(self, points: Points) -> NDArray[np.float64]:
        """[n] distance outside of the side or of an end, whichever is larger; negative inside."""
        height = (points - self.base) @ self.axis
        distances = [self._off_axis(points) - self.radius, -height, height - self.length]
        outside: NDArray[np.float64] = np.max(distances, axis=0)
        return outside

    def _off_axis(self, points: Points) -> Points:
        offset = points - self.base
        distance: Points = np.linalg.norm(offset - (offset @ self.axis)[:, None] * self.axis, axis=1)
        return distance


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
        # A hit of an end sphere counts only beyond the segment; elsewhere the side encloses it and is hit first.
        return np.where(on_side, near, ends)

    def part(self, points: Points) -> NDArray[np.intp]:
        return np.zeros(len(points), np.intp)

    def normals(self, points: Points) -> Points:
        return (points - self._nearest(points)) / self.radius

    def blocks(self, points: Points, directions: Points) -> NDArray[np.bool_]:
        dtype = points.dtype
        start = points - self.start.astype(dtype)
        near, far = _tube(start, directions, self.axis.astype(dtype), self.radius)
        height, along = (start @ self.axis.astype(dtype))[:, None], no_zero(directions @ self.axis.astype(dtype))
        low, high = -height / along, (dtype.type(self.length) - height) / along
        near = np.maximum(near, np.minimum(low, high))
        far = np.minimum(far, np.maximum(low, high))
        hit = far > np.maximum(near, 0) + NEAREST
        hit |= _sphere_blocks(start, directions, self.radius)
        return hit | _sphere_blocks(points - self.end.astype(dtype), directions, self.radius)

    def contains(self, points: Points) -> NDArray[np.bool_]:
        inside: NDArray[np.bool_] = np.linalg.norm(points - self._nearest(points), axis=1) < self.radius - 1e-9
        return inside

    def _nearest(self, points: Points) -> Points:
        """[n, 3] closest points on the segment."""
        height = np.clip((points - self.start) @ self.axis, 0, self.length)
        return self.start + height[:, None] * self.axis


def _tube(start: Points, directions: Points, axis: Points, radius: float) -> tuple[Points, Points]:
    """[points, directions] entry and exit of an infinite cylinder through the origin; near > far: no hit."""
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
    blocked: NDArray[np.bool_] = (b * b > c) & ((b < 0) | (c < 0))
    return blocked
