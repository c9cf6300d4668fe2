"""The threshold of the self-occlusion correction (thesis 6.2.2, eq. 6.3-6.4): how far apart sampled directions lie."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]


def spherical_delaunay(points: Floats) -> NDArray[np.int64]:
    """Triangles [2 n - 4, 3] of the spherical Delaunay triangulation of unit points [n, 3], n >= 4, counter-clockwise
    from outside.

    It is the convex hull, computed by gift wrapping. Raises ValueError for points that do not surround the sphere's
    centre, or if four share an empty circle.
    """
    if len(points) < 4:
        raise ValueError(f"{len(points)} points do not surround a sphere's centre")
    nearest = int(np.argsort(((points - points[0]) ** 2).sum(-1))[1])
    waiting = [(0, nearest)]
    triangle_of: dict[tuple[int, int], tuple[int, int, int]] = {}
    while waiting:
        a, b = waiting.pop()
        if (a, b) in triangle_of:
            continue
        c = _third(points, a, b)
        for edge in ((a, b), (b, c), (c, a)):
            if edge in triangle_of:
                raise ValueError("the directions have no unique triangulation: four of them share an empty circle")
            triangle_of[edge] = (a, b, c)
            waiting.append(edge[::-1])
    triangles = np.array(sorted({_lowest_first(*triangle) for triangle in triangle_of.values()}), np.int64)
    a, b, c = points[triangles].transpose(1, 0, 2)
    if ((np.cross(b - a, c - a) * a).sum(-1) <= 0).any():
        raise ValueError("the directions do not surround the sphere's centre")
    return triangles


def neighbour_angles_rad(directions: Floats) -> Floats:
    """Angles [3 n - 6] between neighbours of the spherical Delaunay triangulation of unit directions [n, 3]."""
    triangles = spherical_delaunay(directions)
    edges = np.sort(np.concatenate([triangles[:, [0, 1]], triangles[:, [1, 2]], triangles[:, [2, 0]]]), axis=1)
    a, b = directions[np.unique(edges, axis=0)].transpose(1, 0, 2)
    angles: Floats = 2 * np.arcsin(np.linalg.norm(a - b, axis=-1) / 2)
    return angles


def occlusion_threshold(directions: Floats) -> float:
    """chi of eq. 6.3 so that V' rises over half the median angle between neighbours, as the text of 6.2.2 wants:
    1 - cos(median / 2)."""
    return float(1 - np.cos(np.median(neighbour_angles_rad(directions)) / 2))


def printed_threshold(directions: Floats) -> float:
    """chi as eq. 6.4 prints it, cos(median / 2): V' then rises over nearly 90 degrees."""
    return float(np.cos(np.median(neighbour_angles_rad(directions)) / 2))


def _third(points: Floats, a: int, b: int) -> int:
    """The point that makes a hull triangle with the directed edge a -> b, on its left seen from outside."""
    edge = points[b] - points[a]
    middle = points[a] + points[b]
    left = np.cross(middle, edge)  # along the sphere, away from the edge
    offset = points - points[a]
    along, inward = offset @ left, -(offset @ middle)
    turn = np.arctan2(inward * np.linalg.norm(left), along * np.linalg.norm(middle))
    turn[turn < -np.pi / 2] += 2 * np.pi  # right of the edge and above it
    turn[[a, b]] = np.inf
    return int(turn.argmin())


def _lowest_first(a: int, b: int, c: int) -> tuple[int, int, int]:
    return min((a, b, c), (b, c, a), (c, a, b))
