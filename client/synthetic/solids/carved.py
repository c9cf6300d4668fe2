"""A solid with a hole, such as an arch or a bowl. The only non-convex kind; it shadows itself."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from client.synthetic.solids.charts import Chart
from client.synthetic.solids.polyhedra import NEAREST, Points, Polyhedron
from client.synthetic.solids.round import Cylinder

CLEARANCE_M = 1e-5
"""Offset of shadow rays from the surface: above float32 rounding, below visibility."""


@dataclass(frozen=True, eq=False)
class Carved:
    """`outer` minus `hole`; both are convex."""

    outer: Polyhedron | Cylinder
    hole: Cylinder

    @property
    def bounds(self) -> tuple[NDArray[np.float64], float]:
        return self.outer.bounds

    @cached_property
    def charts(self) -> list[Chart]:
        """Charts of the outer solid, then of the hole, whose normals point into the solid (`inwards`)."""
        return [*self.outer.charts, *self.hole.charts]

    def inwards(self, part: int) -> bool:
        """Whether a chart belongs to the hole; its normals are opposite to those of the surface."""
        return part >= len(self.outer.charts)

    def intersect(self, origin: Points, directions: Points) -> Points:
        a, b, c, d = (t[0] for t in self._spans(origin[None], directions))
        enters = (a < b) & (a > NEAREST) & ((a < c) | (a >= d))
        leaves_hole = (a < d) & (d < b) & (d > NEAREST)
        return np.where(enters, a, np.where(leaves_hole, d, np.inf))

    def part(self, points: Points) -> NDArray[np.intp]:
        inside = self.outer.contains(points)
        return np.where(inside, len(self.outer.charts) + self.hole.part(points), self.outer.part(points))

    def normals(self, points: Points) -> Points:
        inside = self.outer.contains(points)[:, None]
        return np.where(inside, -self.hole.normals(points), self.outer.normals(points))

    def blocks(self, points: Points, directions: Points) -> NDArray[np.bool_]:
        a, b, c, d = self._spans(points, directions)
        near = np.maximum(a, 0)
        return (np.minimum(b, c) > near + NEAREST) | (b > np.maximum(near, d) + NEAREST)

    def contains(self, points: Points) -> NDArray[np.bool_]:
        return self.outer.contains(points) & (self.hole.outside_m(points) > 1e-9)

    def absent(self, points: Points, part: int) -> NDArray[np.bool_]:
        """[n] True where a point of chart `part` is not on the surface."""
        return ~self.outer.contains(points) if self.inwards(part) else self.hole.outside_m(points) < 1e-9

    def _spans(self, points: Points, directions: Points) -> tuple[Points, Points, Points, Points]:
        """[points, directions] entry and exit of the outer solid, then of the hole (inf, -inf: no hit)."""
        a, b = self.outer.span(points, directions)
        c, d = self.hole.span(points, directions)
        missed = c >= d
        return a, b, np.where(missed, np.inf, c), np.where(missed, -np.inf, d)
