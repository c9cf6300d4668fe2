"""Points spread evenly over a virtual object's surface, made once per mesh. Kernel: surface_points.cl."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pyopencl.cltypes as cl_types
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from server.maths.sh import spherical_fibonacci
from server.objects.voxelize import DistanceGrid
from server.opencl.buffers import BufferDescription, StageBuffers
from server.opencl.engine import Engine, int4
from server.scene.coarse_colors import colors_at
from server.scene.mesh import Mesh

POINTS = 128
"""Positions on an object; each has a point on both sides of the surface."""
CELLS = 8
"""Cells of the table of nearest points along the longest side of an object's grid, as in virtual_point_lights.clh."""
SIDES = 6
_LATTICE = 64

Floats = NDArray[np.float64]


class _Buffers(StageBuffers):
    points = BufferDescription(cl_types.float4)
    normals = BufferDescription(cl_types.float4)
    directions = BufferDescription(cl_types.float4)
    """[_LATTICE] unit."""
    open_counts = BufferDescription(np.int32)
    """[n] of _count_open."""


@dataclass(frozen=True)
class SurfacePoints:
    """Points on one object."""

    points: Floats
    """[n <= 2 POINTS, 3] in cells of the object's distance grid."""
    normals: Floats
    """[n, 3] unit, in model axes (the same as the grid's)."""
    albedos: Floats
    """[n, 3] linear base colour."""
    nearest: NDArray[np.int32]
    """[z, y, x, SIDES] the point nearest to each cell of those that face +x, +y, +z, -x, -y, -z most; -1: none."""


def deal_points(engine: Engine, mesh: Mesh, grid: DistanceGrid) -> SurfacePoints:
    """Points at POINTS positions spread evenly over the mesh's area; deterministic. Points inside closed meshes are
    dropped."""
    corners = mesh.vertices[mesh.triangles].astype(np.float64)
    areas = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    upto = np.cumsum(areas)
    triangle = np.searchsorted(upto, (np.arange(POINTS) + 0.5) / POINTS * upto[-1]).clip(0, len(areas) - 1)
    first, second = (np.arange(1, POINTS + 1)[:, None] * _PLASTIC % 1.0).T
    first, second = np.where(first + second > 1, 1 - first, first), np.where(first + second > 1, 1 - second, second)
    shares = np.stack([1 - first - second, first, second], axis=1)[..., None]
    points, normals = (
        (values[mesh.triangles[triangle]].astype(np.float64) * shares).sum(axis=1)
        for values in (mesh.vertices, mesh.normals)
    )
    albedos = colors_at(mesh, triangle, shares[..., 0])
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
    in_grid = points @ grid.grid_from_model[:3, :3].T + grid.grid_from_model[:3, 3]
    in_grid, normals = np.concatenate([in_grid, in_grid]), np.concatenate([normals, -normals])
    is_open = _count_open(engine, in_grid, normals, grid) > 0
    is_open |= ~is_open.any()
    in_grid, normals, albedos = in_grid[is_open], normals[is_open], np.concatenate([albedos, albedos])[is_open]
    return SurfacePoints(in_grid, normals, albedos, _nearest(in_grid, normals, grid.dims))


def _count_open(engine: Engine, points: Floats, normals: Floats, grid: DistanceGrid) -> NDArray[np.int32]:
    """[n] for each point the number of lattice directions that the object itself does not block."""
    buffers, lattice = engine.buffers(_Buffers), spherical_fibonacci(_LATTICE)
    found = buffers.open_counts.array((len(points),))
    kernel = engine.kernel("surface_points.cl", "count_open", LANES=engine.lanes)
    engine.launch(
        kernel,
        (len(points),),
        len(points),
        buffers.points.upload(float4_rows(points)),
        buffers.normals.upload(float4_rows(normals)),
        _LATTICE,
        buffers.directions.constant(float4_rows(lattice)),
        int4(*grid.dims, 0),
        grid.distance,
        found,
    )
    result: NDArray[np.int32] = engine.download(found)
    return result


_PLASTIC = np.array([0.7548776662466927, 0.5698402909980532])  # steps of the R2 sequence: 1/g, 1/g^2, g^3 = g + 1


def _nearest(points: Floats, normals: Floats, dims: tuple[int, int, int]) -> NDArray[np.int32]:
    side = max(dims) / CELLS
    cells = np.ceil(np.array(dims) / side - 1e-6).astype(int)
    z, y, x = np.mgrid[: cells[2], : cells[1], : cells[0]]
    centers = (np.stack([x, y, z], axis=-1) + 0.5) * side
    axis = np.abs(normals).argmax(axis=1)
    facing = axis + 3 * (normals[np.arange(len(normals)), axis] < 0)
    nearest = np.full((*x.shape, SIDES), -1, np.int32)
    for which in range(SIDES):
        own = np.flatnonzero(facing == which)
        if len(own):
            nearest[..., which] = own[cKDTree(points[own]).query(centers)[1]]
    return nearest


def float4_rows(values: Floats, w: float = 0.0) -> NDArray[np.float32]:
    """[n] float4 of `values` [n, 3], with `w` as the fourth."""
    padded = np.full((len(values), 4), w, np.float32)
    padded[:, :3] = values
    return padded.view(cl_types.float4)[:, 0]
