"""Charts: coordinates in [0, 1]^2 of smooth surfaces, and an atlas of sample grids over many charts."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

Points = NDArray[np.float64]


class Chart(Protocol):
    """Coordinates (s, t) on a surface. `wraps`: s = 1 is the same as s = 0."""

    @property
    def wraps(self) -> bool: ...

    @property
    def lengths_m(self) -> tuple[float, float]:
        """Upper bound of the lengths along s and t."""

    def point(self, s: Points, t: Points) -> tuple[Points, Points]:
        """Positions and outward unit normals, each [..., 3]."""

    def coordinates(self, points: Points) -> tuple[Points, Points]:
        """s and t [n] of surface points [n, 3]."""


@dataclass(frozen=True, eq=False)
class PlaneChart:
    """A rectangle around a flat face."""

    corner: NDArray[np.float64]
    axis_u: NDArray[np.float64]
    axis_v: NDArray[np.float64]
    normal: NDArray[np.float64]
    lengths_m: tuple[float, float]
    wraps: bool = False

    @classmethod
    def around(cls, face: Points, normal: NDArray[np.float64], axis_u: NDArray[np.float64]) -> PlaneChart:
        """The bounding rectangle along unit `axis_u` of the corners `face` [n, 3] of a flat face."""
        axis_v = np.cross(normal, axis_u)
        u, v = face @ axis_u, face @ axis_v
        corner = u.min() * axis_u + v.min() * axis_v + (face[0] @ normal) * normal
        return cls(corner, axis_u, axis_v, normal, (float(np.ptp(u)), float(np.ptp(v))))

    def point(self, s: Points, t: Points) -> tuple[Points, Points]:
        u, v = s[..., None] * self.lengths_m[0], t[..., None] * self.lengths_m[1]
        points = self.corner + u * self.axis_u + v * self.axis_v
        return points, np.broadcast_to(self.normal, points.shape)

    def coordinates(self, points: Points) -> tuple[Points, Points]:
        offset = points - self.corner
        return offset @ self.axis_u / self.lengths_m[0], offset @ self.axis_v / self.lengths_m[1]


@dataclass(frozen=True, eq=False)
class SphereChart:
    """Azimuth about y, and the angle from +y."""

    center: NDArray[np.float64]
    radius: float
    wraps: bool = True

    @property
    def lengths_m(self) -> tuple[float, float]:
        return 2 * math.pi * self.radius, math.pi * self.radius

    def point(self, s: Points, t: Points) -> tuple[Points, Points]:
        azimuth, polar = 2 * np.pi * s, np.pi * t
        normals = np.stack([np.sin(polar) * np.sin(azimuth), np.cos(polar), np.sin(polar) * np.cos(azimuth)], axis=-1)
        return self.center + self.radius * normals, normals

    def coordinates(self, points: Points) -> tuple[Points, Points]:
        x, y, z = ((points - self.center) / self.radius).T
        return np.arctan2(x, z) / (2 * np.pi) % 1, np.arccos(np.clip(y, -1, 1)) / np.pi


@dataclass(frozen=True, eq=False)
class CylinderChart:
    """Azimuth about the axis, and the height along it."""

    base: NDArray[np.float64]
    axis: NDArray[np.float64]
    length: float
    radius: float
    wraps: bool = True

    @property
    def lengths_m(self) -> tuple[float, float]:
        return 2 * math.pi * self.radius, self.length

    def point(self, s: Points, t: Points) -> tuple[Points, Points]:
        u, v = frame_around(self.axis)
        azimuth = 2 * np.pi * s[..., None]
        normals = np.sin(azimuth) * u + np.cos(azimuth) * v
        return self.base + t[..., None] * self.length * self.axis + self.radius * normals, normals

    def coordinates(self, points: Points) -> tuple[Points, Points]:
        u, v = frame_around(self.axis)
        offset = points - self.base
        return np.arctan2(offset @ u, offset @ v) / (2 * np.pi) % 1, offset @ self.axis / self.length


@dataclass(frozen=True, eq=False)
class CapsuleChart:
    """Azimuth about the axis, and arc length from pole to pole."""

    start: NDArray[np.float64]
    axis: NDArray[np.float64]
    length: float
    radius: float
    wraps: bool = True

    @property
    def lengths_m(self) -> tuple[float, float]:
        return 2 * math.pi * self.radius, self.length + math.pi * self.radius

    def point(self, s: Points, t: Points) -> tuple[Points, Points]:
        u, v = frame_around(self.axis)
        azimuth = 2 * np.pi * s[..., None]
        arc = t[..., None] * self.lengths_m[1] - math.pi / 2 * self.radius
        height = np.clip(arc, 0, self.length)
        tilt = (arc - height) / self.radius
        normals = np.cos(tilt) * (np.sin(azimuth) * u + np.cos(azimuth) * v) + np.sin(tilt) * self.axis
        return self.start + height * self.axis + self.radius * normals, normals

    def coordinates(self, points: Points) -> tuple[Points, Points]:
        u, v = frame_around(self.axis)
        offset = points - self.start
        height = offset @ self.axis
        on_segment = np.clip(height, 0, self.length)
        tilt = np.arcsin(np.clip((height - on_segment) / self.radius, -1, 1))
        arc = on_segment + self.radius * (tilt + math.pi / 2)
        return np.arctan2(offset @ u, offset @ v) / (2 * np.pi) % 1, arc / self.lengths_m[1]


def frame_around(axis: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Two unit vectors orthogonal to unit `axis` [3] and to each other."""
    helper = np.array([1.0, 0, 0]) if abs(axis[0]) < 0.8 else np.array([0, 1.0, 0])
    u = np.cross(helper, axis)
    u /= np.linalg.norm(u)
    return u, np.cross(axis, u)


@dataclass(frozen=True, eq=False)
class Grid:
    """Samples of one chart, `rows` along t and `columns` along s; their values start at `offset` of a table."""

    chart: Chart
    columns: int
    rows: int
    offset: int

    @classmethod
    def over(cls, chart: Chart, step_m: float, offset: int) -> Grid:
        """A grid with samples at most `step_m` apart, and at least 8 columns if the chart wraps."""
        across, along = (math.ceil(length / step_m) for length in chart.lengths_m)
        columns = max(across, 8) if chart.wraps else across + 1
        return cls(chart, columns, along + 1, offset)

    @property
    def is_flat(self) -> bool:
        return isinstance(self.chart, PlaneChart)

    @property
    def size(self) -> int:
        return self.rows * self.columns

    def samples(self) -> tuple[Points, Points]:
        """Positions and normals, [rows, columns, 3] each."""
        s = np.arange(self.columns) / (self.columns if self.chart.wraps else max(self.columns - 1, 1))
        t = np.arange(self.rows) / max(self.rows - 1, 1)
        return self.chart.point(*np.meshgrid(s, t))

    def interpolate(self, table: NDArray[np.float32], points: Points) -> NDArray[np.float32]:
        """[n, k] bilinear interpolation of table values [total, k] at surface points [n, 3]."""
        s, t = self.chart.coordinates(points)
        x = s * (self.columns if self.chart.wraps else self.columns - 1)
        y = np.clip(t, 0, 1) * (self.rows - 1)
        if not self.chart.wraps:
            x = np.clip(x, 0, self.columns - 1)
        left, above = x.astype(np.intp), y.astype(np.intp)
        right, below = left + 1, np.minimum(above + 1, self.rows - 1)
        right = right % self.columns if self.chart.wraps else np.minimum(right, self.columns - 1)
        left = left % self.columns
        values = table[self.offset : self.offset + self.size]
        fx, fy = ((x - np.floor(x)).astype(np.float32)[:, None], (y - np.floor(y)).astype(np.float32)[:, None])
        upper = values[above * self.columns + left] * (1 - fx) + values[above * self.columns + right] * fx
        lower = values[below * self.columns + left] * (1 - fx) + values[below * self.columns + right] * fx
        mixed: NDArray[np.float32] = upper * (1 - fy) + lower * fy
        return mixed


def atlas(charts: list[list[Chart]], step_m: float) -> list[list[Grid]]:
    """Grids over all charts of all solids, consecutive in one table."""
    grids, offset = [], 0
    for of_solid in charts:
        row = []
        for chart in of_solid:
            row.append(Grid.over(chart, step_m, offset))
            offset += row[-1].size
        grids.append(row)
    return grids
