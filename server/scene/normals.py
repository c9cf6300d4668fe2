"""Computes vertex normals for a mesh without: smooth over gentle edges, split at creases."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

CREASE_DEG = 40.0
"""Triangles that share an edge are smoothed if their normals differ by less."""
MOST_AT_EDGE = 8
"""Triangles at one edge of which each is compared with each; of more, those that come soon after one another."""

Ints = NDArray[np.int64]
Floats = NDArray[np.float64]


def face_crosses(vertices: NDArray[Any], triangles: Ints) -> Floats:
    """[t, 3] cross products of each triangle's edges: twice its area along its normal."""
    a, b, c = (vertices[triangles[:, k]].astype(np.float64) for k in range(3))
    return np.cross(b - a, c - a)


def unit(vectors: Floats) -> Floats:
    """Each row divided by its length; zero rows stay zero."""
    lengths = np.linalg.norm(vectors, axis=1, keepdims=True)
    return vectors / np.where(lengths > 0, lengths, 1.0)


def creased_normals(vertices: NDArray[Any], triangles: Ints) -> tuple[Ints, Ints, Floats]:
    """Split vertices so that each has one normal.

    `vertices` [v, 3], `triangles` [t, 3] with area above zero. Returns `source` [n] (the vertex each new vertex
    copies), `triangles` [t, 3] into the new vertices, and unit `normals` [n, 3]: the mean of the triangles around it
    that are joined over edges of less than CREASE_DEG, weighted by their corner angles. Vertices at the same place
    count as one.
    """
    faces = unit(face_crosses(vertices, triangles))
    group = _joined(3 * len(triangles), _smooth_links(numbered(vertices)[triangles], faces))
    corner_normals = np.repeat(faces, 3, axis=0) * corner_angles(vertices, triangles).reshape(-1, 1)
    sums = np.zeros((3 * len(triangles), 3))
    np.add.at(sums, group, corner_normals)
    key = group * (len(vertices) + 1) + triangles.reshape(-1)
    _, first, inverse = np.unique(key, return_index=True, return_inverse=True)
    normals = unit(sums[group[first]])
    lost = ~normals.any(axis=1)  # opposite faces that cancel out
    normals[lost] = faces[first[lost] // 3]
    return triangles.reshape(-1)[first], inverse.reshape(-1, 3), normals


def numbered(rows: NDArray[Any]) -> Ints:
    """[n] an index for each row, equal for equal rows."""
    order = np.lexsort(rows.T)
    fresh = np.ones(len(rows), np.int64)
    fresh[1:] = (np.diff(rows[order], axis=0) != 0).any(axis=1)
    number = np.empty(len(rows), np.int64)
    number[order] = np.cumsum(fresh) - 1
    return number


def _smooth_links(places: Ints, faces: Floats) -> Ints:
    """[n, 2] pairs of corners (3 * triangle + k) that meet over a gentle edge; `places` [t, 3]."""
    corner = np.arange(places.size).reshape(-1, 3)
    start, end = corner.reshape(-1), np.roll(corner, -1, axis=1).reshape(-1)
    at = places.reshape(-1)
    swap = at[start] > at[end]
    low, high = np.where(swap, end, start), np.where(swap, start, end)
    key = at[low] * (at.max(initial=0) + 1) + at[high]
    order = np.argsort(key, kind="stable")
    links = [np.zeros((0, 2), np.int64)]
    for apart in range(1, MOST_AT_EDGE):  # a board of two sides has four triangles at an edge
        this, other = order[:-apart], order[apart:]
        meets = key[this] == key[other]
        if not meets.any():
            break
        this, other = this[meets], other[meets]
        gentle = (faces[this // 3] * faces[other // 3]).sum(axis=1) > np.cos(np.radians(CREASE_DEG))
        this, other = this[gentle], other[gentle]
        links += [np.stack([low[this], low[other]], 1), np.stack([high[this], high[other]], 1)]
    return np.concatenate(links)


def _joined(count: int, links: Ints) -> Ints:
    """[count] lowest member of each item's connected component under `links` [n, 2] (pointer jumping)."""
    label = np.arange(count)
    while True:
        ends = label[links]
        lowest = ends.min(axis=1)
        if (ends == lowest[:, None]).all():
            return label
        np.minimum.at(label, ends[:, 0], lowest)
        np.minimum.at(label, ends[:, 1], lowest)
        while (label[label] != label).any():
            label = label[label]


def corner_angles(vertices: NDArray[Any], triangles: Ints) -> Floats:
    """[t, 3] the angle of each triangle at each of its corners, radians."""
    corners = vertices[triangles].astype(np.float64)
    onward = np.roll(corners, -1, axis=1) - corners
    back = np.roll(corners, 1, axis=1) - corners
    sine = np.linalg.norm(np.cross(onward, back), axis=2)
    angles: Floats = np.arctan2(sine, (onward * back).sum(axis=2))
    return angles
