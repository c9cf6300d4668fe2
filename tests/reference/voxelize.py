"""Float64 twin of cl_kernels/voxelize.cl, and of the rays of include/virtual_objects.clh."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]


def overlaps_cell(triangles: Floats, centers: Floats, half: float) -> NDArray[np.bool_]:
    """[n] whether each of `triangles` [n, 3, 3] touches the cube around its center: all 13 axes (Akenine-Moeller)."""
    edges = np.roll(triangles, -1, axis=1) - triangles
    axes = [np.broadcast_to(axis, centers.shape) for axis in np.eye(3)] + [np.cross(edges[:, 0], edges[:, 1])]
    axes += [np.cross(edges[:, k], axis) for k in range(3) for axis in np.eye(3)]
    offsets = triangles - centers[:, None]
    touches = np.ones(len(centers), bool)
    for axis in axes:
        corners = (offsets * axis[:, None]).sum(-1)
        reach = half * np.abs(axis).sum(-1)
        touches &= (corners.max(axis=1) >= -reach) & (corners.min(axis=1) <= reach)
    return touches


def mark_cells(vertices: Floats, triangles: NDArray[np.int64], dims: tuple[int, int, int], half: float) -> Floats:
    """[z, y, x] bool: the cells (cubes of half width `half` around i + 0.5) that a triangle touches; grid units."""
    corners = vertices[triangles]
    low = np.maximum(np.floor(corners.min(axis=1) - 0.01).astype(int), 0)
    size = np.minimum(np.floor(corners.max(axis=1) + 0.01).astype(int) + 1, dims) - low
    count = np.maximum(size, 0).prod(axis=1)
    triangle = np.repeat(np.arange(len(triangles)), count)  # one entry a triangle and cell of its box
    number = np.arange(count.sum()) - np.repeat(np.cumsum(count) - count, count)
    along_x, along_y = size[triangle, 0], size[triangle, 1]
    in_box = np.stack([number % along_x, number // along_x % along_y, number // (along_x * along_y)], axis=-1)
    cells = low[triangle] + in_box
    x, y, z = cells[overlaps_cell(corners[triangle], cells + 0.5, half)].T
    occupied = np.zeros(dims[::-1], bool)
    occupied[z, y, x] = True
    return occupied


def distance_transform(occupied: NDArray[np.bool_]) -> Floats:
    """[z, y, x] distance from each cell to the nearest occupied one, in cells, by looking at all of them."""
    places = np.argwhere(occupied)
    cells = np.argwhere(np.ones_like(occupied))
    squared = np.array([((places - cell) ** 2).sum(axis=1).min() for cell in cells])
    return np.sqrt(squared).reshape(occupied.shape)


def distance_to_mesh(points: Floats, vertices: Floats, triangles: NDArray[np.int64]) -> Floats:
    """[n] distance of each point to the nearest triangle: to its plane where above its inside, else to its edges."""
    nearest = np.full(len(points), np.inf)
    for corners in vertices[triangles]:
        normal = np.cross(corners[1] - corners[0], corners[2] - corners[0])
        above = np.ones(len(points), bool)
        for start, end in zip(corners, np.roll(corners, -1, axis=0), strict=True):
            edge = end - start
            share = np.clip((points - start) @ edge / max(edge @ edge, 1e-300), 0, 1)
            nearest = np.minimum(nearest, np.linalg.norm(points - start - share[:, None] * edge, axis=1))
            above &= (points - start) @ np.cross(normal, edge) >= 0
        if normal.any():
            height = np.abs((points - corners[0]) @ normal) / np.linalg.norm(normal)
            nearest = np.where(above, np.minimum(nearest, height), nearest)
    return nearest


def trace_mesh(vertices: Floats, triangles: NDArray[np.int64], origins: Floats, directions: Floats) -> Floats:
    """[n] distance along each ray to the mesh itself, infinite where it passes (Moeller and Trumbore)."""
    a = vertices[triangles[:, 0]]
    ab, ac = vertices[triangles[:, 1]] - a, vertices[triangles[:, 2]] - a
    nearest = np.full(len(origins), np.inf)
    for index, (origin, direction) in enumerate(zip(origins, directions, strict=True)):
        p = np.cross(direction, ac)
        determinant = (ab * p).sum(axis=1)
        with np.errstate(divide="ignore", invalid="ignore"):
            inverse = 1 / determinant
            offset = origin - a
            u = (offset * p).sum(axis=1) * inverse
            q = np.cross(offset, ab)
            v, t = (q @ direction) * inverse, (ac * q).sum(axis=1) * inverse
            hit = (determinant != 0) & (u >= 0) & (v >= 0) & (u + v <= 1) & (t > 0)
        nearest[index] = t[hit].min(initial=np.inf)
    return nearest
