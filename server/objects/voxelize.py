"""Distance grids of virtual objects, and the table of them for ray tracing (thesis 7.2, fig. 7.5).

Kernels: voxelize.cl; rays: include/virtual_objects.clh.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import accumulate
from typing import TYPE_CHECKING

import numpy as np
import pyopencl as cl
import pyopencl.array as cl_array
import pyopencl.cltypes as cl_types
from numpy.typing import NDArray

from server.objects.object_tree import FEW_OBJECTS, grid_boxes, tree_rows
from server.opencl.engine import Engine, float16, int4
from server.opencl.parts import Parts
from server.opencl.transfer import copy_into

if TYPE_CHECKING:
    from server.objects.virtual_object import VirtualObject

MARGIN_CELLS = 2
"""Free cells around the mesh, on every side."""
NEAR_CELLS = 1.65
"""Distances up to here are measured to the triangles."""
LEAST_CELLS = 8
MOST_CELLS = 256
_SLAB = 8

Matrix = NDArray[np.float64]
Vector = NDArray[np.float64]


@dataclass(frozen=True)
class DistanceGrid:
    """How far the centre of each cell is from the mesh."""

    distance: cl_array.Array
    """[z, y, x] float32, cells: up to NEAR_CELLS to the nearest triangle; beyond, to the centre of the nearest cell
    that a triangle touches, which is exact to half a cell's diagonal.
    """
    grid_from_model: Matrix
    """[4, 4] model metres to cells; the centre of cell i lies at i + 0.5."""

    @property
    def dims(self) -> tuple[int, int, int]:
        """Cells in x, y and z."""
        z, y, x = self.distance.shape
        return x, y, z

    @property
    def cells_per_m(self) -> float:
        """Cells to a model metre."""
        return float(self.grid_from_model[0, 0])


@dataclass(frozen=True)
class ObjectTable:
    """What `trace_objects` of virtual_objects.clh takes; arrays of the engine's workspace, valid until the next one."""

    count: int
    rows: Parts
    """`grid_from_volume` and `dims`, in one buffer."""
    distances: cl_array.Array
    """All distance grids one after the other, each once, float32, cells."""
    cell_m: tuple[float, ...]
    """Side of each object's cells in volume metres: how far off its surface a ray must start."""

    @property
    def grid_from_volume(self) -> cl_array.Array:
        """[count] float16: row-major 4x4, volume metres to cells; where there are many, then a tree of their boxes."""
        return self.rows.array("grid_from_volume")

    @property
    def dims(self) -> cl_array.Array:
        """[count] int4: cells in x, y, z, and where the object's distances begin in the pool."""
        return self.rows.array("dims")


def voxelize(
    engine: Engine, vertices: cl_array.Array, triangles: cl_array.Array, bounds: tuple[Vector, Vector], cells: int = 64
) -> DistanceGrid:
    """Distance grid of a mesh: vertices [v, 3] float32, triangles [t, 3] int32, `cells` along its longest side.

    The distance array is the caller's to keep. Raises ValueError for a number of cells out of range.
    """
    dims, grid_from_model = place_grid(*bounds, cells)
    space, shape = engine.workspace, dims[::-1]
    occupied, near = (space.array(f"voxelize_{name}", shape, np.int32) for name in ("occupied", "near"))
    engine.launch(_kernel(engine, "clear_cells"), (occupied.size,), occupied.size, occupied, near)
    for name, cells_of in (("mark_cells", occupied), ("measure_near", near)):
        engine.launch(
            _kernel(engine, name),
            (len(triangles), -(-dims[2] // _SLAB)),
            len(triangles),
            int4(*dims, 0),
            vertices,
            triangles,
            float16(grid_from_model),
            cells_of,
        )
    distance = cl_array.empty(engine.queue, shape, np.float32)
    squared = squared_distance(engine, occupied)
    engine.launch(_kernel(engine, "finish_distance"), (squared.size,), squared.size, squared, near, distance)
    return DistanceGrid(distance, grid_from_model)


def _kernel(engine: Engine, name: str) -> cl.Kernel:
    return engine.kernel("voxelize.cl", name, SLAB=_SLAB)


def place_grid(low: Vector, high: Vector, cells: int) -> tuple[tuple[int, int, int], Matrix]:
    """Cells in x, y, z of the grid around the box `low` to `high`, and `grid_from_model` [4, 4].

    The box begins at the centre of cell MARGIN_CELLS on each axis and, on its longest, ends at the centre of another:
    walls along the axes then mark one layer of cells, not the two that share a face.
    """
    if not LEAST_CELLS <= cells <= MOST_CELLS:
        raise ValueError(f"a distance grid of {cells} cells is not possible: {LEAST_CELLS} to {MOST_CELLS} are")
    extent = high - low
    first = MARGIN_CELLS + 0.5
    cells_per_m = (cells - 2 * first) / float(extent.max())
    grid_from_model = np.diag([cells_per_m] * 3 + [1.0])
    grid_from_model[:3, 3] = first - cells_per_m * low
    last = np.floor(first + cells_per_m * extent + 1e-3).astype(int)
    x, y, z = (int(index) + 1 + MARGIN_CELLS for index in last)
    return (x, y, z), grid_from_model


def squared_distance(engine: Engine, occupied: cl_array.Array) -> cl_array.Array:
    """Squared cells from each cell to the nearest that is occupied (not 0), [z, y, x] int32; 2^28 where none is.

    Exact, axis by axis (Felzenszwalb and Huttenlocher). The array is the workspace's, valid until the next call.
    """
    space, (z, y, x), cells = engine.workspace, occupied.shape, occupied.size
    one, other = (space.array(f"voxelize_squared_{k}", occupied.shape, np.int32) for k in (0, 1))
    spread = _kernel(engine, "spread_distance")
    engine.launch(_kernel(engine, "seed_distance"), (y * z,), int4(x, y, z, 0), occupied, one)
    engine.launch(spread, (cells,), cells, y, x, one, other)
    engine.launch(spread, (cells,), cells, z, x * y, other, one)
    return one


def object_table(engine: Engine, objects: Sequence[tuple[VirtualObject, Matrix]]) -> ObjectTable:
    """The table of `objects`, each with its `volume_from_model` [4, 4]: rotation, uniform scale and translation.

    A mesh that is placed several times is kept once; distances are copied only when the set of meshes changes.
    """
    space, count = engine.workspace, len(objects)
    grids = [thing.grid for thing, _ in objects]
    pool, starts = _gather_distances(engine, [grid.distance for grid in grids])
    dims = np.array([(*grid.dims, starts[id(grid.distance)]) for grid in grids] or [(0, 0, 0, 0)], np.int32)
    grid_from_model = np.array([grid.grid_from_model for grid in grids]).reshape(-1, 4, 4)
    matrices = grid_from_model @ np.linalg.inv(np.array([matrix for _, matrix in objects]).reshape(-1, 4, 4))
    rows = [matrices.reshape(-1, 16)]
    if count > FEW_OBJECTS:
        rows.append(tree_rows(*grid_boxes(matrices, dims[:, :3])))
    table = np.concatenate(rows if count else [np.zeros((1, 16))]).astype(np.float32)
    return ObjectTable(
        count=count,
        rows=space.upload_parts(
            "object_table",
            {"grid_from_volume": table.view(cl_types.float16)[:, 0], "dims": dims.view(cl_types.int4)[:, 0]},
        ),
        distances=pool,
        cell_m=tuple((1 / np.linalg.norm(matrices[:, 0, :3], axis=1)).tolist()),
    )


class _PooledGrids:
    """The grids whose distances are in an engine's pool, in their order."""

    grids: tuple[cl_array.Array, ...] = ()


def _gather_distances(engine: Engine, grids: list[cl_array.Array]) -> tuple[cl_array.Array, dict[int, int]]:
    """Each of the `grids` once, one after the other, and by a grid's id where it begins; a single one is not copied."""
    unique = tuple({id(grid): grid for grid in grids}.values())
    first = accumulate((grid.size for grid in unique), initial=0)
    starts = {id(grid): start for grid, start in zip(unique, first, strict=False)}
    if len(unique) == 1:
        return unique[0], starts
    total = sum(grid.size for grid in unique)
    if total >= 1 << 31:
        raise ValueError(f"the objects' distance grids have {total} cells, more than 2^31: place fewer objects")
    pooled, before = engine.state(_PooledGrids), engine.workspace.find("object_distances")
    pool = engine.workspace.array("object_distances", (max(total, 1),), np.float32)
    if pool is not before or [*map(id, pooled.grids)] != [*map(id, unique)]:
        for grid in unique:
            copy_into(engine.queue, pool, 4 * starts[id(grid)], grid)
        pooled.grids = unique
    return pool, starts
