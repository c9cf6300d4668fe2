"""What virtual objects send: one bounce of light off a few points of each (thesis 7.3.3, eq. 7.3-7.7).

The points are dealt over an object's surface once, on both of its sides. Every frame they are lit as its pixels are;
rays that meet the object take what the points around send. Kernels: differential_rendering.cl (light_points),
include/object_glow.clh.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING
from weakref import WeakKeyDictionary

import numpy as np
import pyopencl.array as cl_array
import pyopencl.cltypes as cl_types
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from server.maths.sh import spherical_fibonacci
from server.opencl.engine import Engine, KernelArgument, int4
from server.scene.coarse_colors import colors_at

if TYPE_CHECKING:
    from server.scene.mesh import Mesh
    from server.stages.rasterize import Placed
    from server.stages.voxelize import DistanceGrid

POINTS = 128
"""Places on an object; at each, a point on either side."""
CELLS = 8
"""Cells of the table of nearest points along the longest side of an object's grid, as in object_glow.clh."""
SIDES = 6
_LATTICE = 64

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class SurfacePoints:
    """Points on one object."""

    points: Floats
    """[n <= 2 POINTS, 3] in cells of the object's distance grid."""
    normals: Floats
    """[n, 3] unit, model axes, which are the grid's."""
    albedos: Floats
    """[n, 3] linear base colour."""
    nearest: NDArray[np.int32]
    """[z, y, x, SIDES] the point nearest to each cell of those that face +x, +y, +z, -x, -y, -z most; -1: none."""


def deal_points(engine: Engine, mesh: Mesh, grid: DistanceGrid) -> SurfacePoints:
    """Points at POINTS places evenly over the mesh's area, the same for the same mesh; none inside what is closed."""
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
    """[n] directions, out of a lattice, in which the object does not hide the outside from its own points."""
    space, lattice = engine.workspace, spherical_fibonacci(_LATTICE)
    found = space.array("glow_open", (len(points),), np.int32)
    kernel = engine.kernel("differential_rendering.cl", "count_open", BANDS=2, MASK_WORDS=1, LANES=engine.lanes)
    engine.launch(
        kernel,
        (len(points),),
        len(points),
        space.upload("glow_tested", _float4(points)),
        space.upload("glow_tested_normals", _float4(normals)),
        _LATTICE,
        space.constant("glow_lattice", _float4(lattice)),
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


@dataclass(frozen=True)
class Glow:
    """What Glow of object_glow.clh takes; arrays of the engine's workspace, valid until the next frame."""

    nearest: cl_array.Array
    cells: cl_array.Array
    points: cl_array.Array
    normals: cl_array.Array
    radiances: cl_array.Array

    def arguments(self) -> tuple[KernelArgument, ...]:
        """In the order of OBJECT_PARAMETERS of include/shadows.clh."""
        return self.nearest, self.cells, self.points, self.normals, self.radiances


@dataclass(frozen=True)
class PlacedPoints:
    """The points of all objects, to be lit."""

    count: int
    points: cl_array.Array
    """[count] float4: volume metres, w = 1."""
    normals: cl_array.Array
    """[count] float4: unit, volume axes."""
    colors: Floats
    """[count, 3] albedos on the host."""
    albedos: cl_array.Array
    """[count] float4."""
    offsets_m: cl_array.Array
    """[count] float32: how far off its surface rays of a point begin."""
    glow: Glow
    """With nothing sent yet."""

    def under_even_light(self, radiance: Floats) -> NDArray[np.float32]:
        """[count] float4: what the points send under a light [3] from everywhere."""
        return _float4(self.colors * radiance, 1.0)


def no_glow(engine: Engine, objects: int = 1) -> Glow:
    """So many objects that send nothing: they have no cells."""
    count = max(objects, 1)
    empty = engine.workspace.constant("no_glow", np.zeros(1, cl_types.float4))
    return Glow(
        engine.workspace.constant("no_glow_nearest", np.full(SIDES, -1, np.int32)),
        engine.workspace.constant(f"no_glow_cells_{count}", np.zeros(count, cl_types.int4)),
        empty,
        empty,
        empty,
    )


@dataclass(frozen=True)
class _Gathered:
    """The points of several objects, one object's after the other's, apart from where they stand."""

    surfaces: tuple[SurfacePoints, ...]
    owners: NDArray[np.int64]
    """[n] which object."""
    points: Floats
    normals: Floats
    albedos: Floats
    nearest: NDArray[np.int32]
    """As Glow has it."""
    cells: NDArray[np.int32]
    """[objects, 4]."""


_GATHERED: WeakKeyDictionary[Engine, _Gathered] = WeakKeyDictionary()
"""Of each engine's last objects: they move from frame to frame, but seldom change."""


def _gather(engine: Engine, surfaces: tuple[SurfacePoints, ...]) -> _Gathered:
    held = _GATHERED.get(engine)
    if held is not None and [*map(id, held.surfaces)] == [*map(id, surfaces)]:
        return held
    counts, sizes = [len(s.points) for s in surfaces], [s.nearest[..., 0].size for s in surfaces]
    first, start = np.cumsum([0, *counts[:-1]]), np.cumsum([0, *sizes[:-1]])
    nearest = np.concatenate([s.nearest.ravel() for s in surfaces])
    shift = np.repeat(first, np.multiply(sizes, SIDES))
    gathered = _Gathered(
        surfaces,
        np.repeat(np.arange(len(surfaces)), counts),
        np.concatenate([s.points for s in surfaces]),
        np.concatenate([s.normals for s in surfaces]),
        np.concatenate([s.albedos for s in surfaces]),
        np.where(nearest >= 0, nearest + shift, -1).astype(np.int32),
        np.column_stack([[s.nearest.shape[2::-1] for s in surfaces], start]).astype(np.int32),
    )
    _GATHERED[engine] = gathered
    return gathered


def place_points(engine: Engine, objects: Sequence[Placed]) -> PlacedPoints:
    """The points of `objects`, each with its `volume_from_model`, where they are now."""
    space, every = engine.workspace, _gather(engine, tuple(thing.surface_points for thing, _ in objects))
    volume_from_model = np.array([matrix for _, matrix in objects])
    volume_from_grid = volume_from_model @ np.linalg.inv(np.array([thing.grid.grid_from_model for thing, _ in objects]))
    points = _turned(volume_from_grid[:, :3, :3], every.owners, every.points) + volume_from_grid[every.owners, :3, 3]
    normals = _turned(volume_from_model[:, :3, :3], every.owners, every.normals)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    cells_m = np.linalg.norm(volume_from_grid[:, :3, 0], axis=1)
    return PlacedPoints(
        len(points),
        space.upload("glow_places", _float4(points, 1.0)),
        space.upload("glow_place_normals", _float4(normals)),
        every.albedos,
        space.upload("glow_albedos", _float4(every.albedos)),
        space.upload("glow_offsets", cells_m[every.owners].astype(np.float32)),
        Glow(
            space.upload("glow_nearest", every.nearest),
            space.upload("glow_cells", every.cells.view(cl_types.int4)[:, 0]),
            space.upload("glow_points", _float4(every.points)),
            space.upload("glow_normals", _float4(every.normals)),
            space.upload("glow_nothing", np.zeros(len(points), cl_types.float4)),
        ),
    )


def _turned(matrices: Floats, owners: NDArray[np.int64], vectors: Floats) -> Floats:
    """[n, 3] each of `vectors` by its owner's matrix [objects, 3, 3]."""
    turned: Floats = np.einsum("nij,nj->ni", matrices[owners], vectors)
    return turned


def _float4(values: Floats, w: float = 0.0) -> NDArray[np.float32]:
    padded = np.full((len(values), 4), w, np.float32)
    padded[:, :3] = values
    return padded.view(cl_types.float4)[:, 0]
