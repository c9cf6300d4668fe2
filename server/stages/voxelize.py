"""Distance grids of virtual objects, and the table of them that rays are traced through (thesis 7.2, fig. 7.5).

Kernels: voxelize.cl; rays: include/virtual_objects.clh.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import pyopencl.array as cl_array
import pyopencl.cltypes as cl_types
from numpy.typing import NDArray

from server.opencl.engine import Engine, float16, int4

if TYPE_CHECKING:
    from server.scene.virtual_object import VirtualObject

MARGIN_CELLS = 2
"""Free cells around the mesh, on every side."""
LEAST_CELLS = 8
MOST_CELLS = 256
_SLAB = 4

Matrix = NDArray[np.float64]
Vector = NDArray[np.float64]


@dataclass(frozen=True)
class DistanceGrid:
    """How far each cell is from the nearest that the mesh touches."""

    distance: cl_array.Array
    """[z, y, x] float32, cells, from centre to centre; 0 where a triangle touches the cell."""
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
    grid_from_volume: cl_array.Array
    """[count] float16: row-major 4x4, volume metres to cells."""
    dims: cl_array.Array
    """[count] int4: cells in x, y, z, and where the object's distances begin in the pool."""
    distances: cl_array.Array
    """All distance grids one after the other, float32, cells."""
    cell_m: tuple[float, ...]
    """Side of each object's cells in volume metres: how far off its surface a ray must start."""


def voxelize(
    engine: Engine, vertices: cl_array.Array, triangles: cl_array.Array, bounds: tuple[Vector, Vector], cells: int = 64
) -> DistanceGrid:
    """Distance grid of a mesh: vertices [v, 3] float32, triangles [t, 3] int32, `cells` along its longest side.

    The distance array is the caller's to keep. Raises ValueError for a number of cells out of range.
    """
    dims, grid_from_model = place_grid(*bounds, cells)
    shape = dims[::-1]
    occupied = engine.workspace.upload("voxelize_occupied", np.zeros(shape, np.int32))
    engine.launch(
        engine.kernel("voxelize.cl", "mark_cells", SLAB=_SLAB),
        (len(triangles), -(-dims[2] // _SLAB)),
        len(triangles),
        int4(*dims, 0),
        vertices,
        triangles,
        float16(grid_from_model),
        occupied,
    )
    return DistanceGrid(_transform(engine, occupied), grid_from_model)


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


def _transform(engine: Engine, occupied: cl_array.Array) -> cl_array.Array:
    """Exact Euclidean distance transform (Felzenszwalb and Huttenlocher: axis by axis), a new array like `occupied`."""
    space, (z, y, x) = engine.workspace, occupied.shape
    one, other = (space.array(f"voxelize_squared_{k}", occupied.shape, np.int32) for k in (0, 1))
    distance = cl_array.empty(engine.queue, occupied.shape, np.float32)
    cells = occupied.size

    def launch(name: str, size: int, *arguments: object) -> None:
        engine.launch(engine.kernel("voxelize.cl", name, SLAB=_SLAB), (size,), *arguments)  # type: ignore[arg-type]

    launch("seed_distance", y * z, int4(x, y, z, 0), occupied, one)
    launch("spread_distance", cells, cells, y, x, one, other)
    launch("spread_distance", cells, cells, z, x * y, other, one)
    launch("finish_distance", cells, cells, one, distance)
    return distance


def object_table(engine: Engine, objects: Sequence[tuple[VirtualObject, Matrix]]) -> ObjectTable:
    """The table of `objects`, each with its `volume_from_model` [4, 4]: rotation, uniform scale and translation."""
    space = engine.workspace
    matrices = [thing.grid.grid_from_model @ np.linalg.inv(matrix) for thing, matrix in objects]
    sizes = [thing.grid.distance.size for thing, _ in objects]
    starts = [sum(sizes[:index]) for index in range(len(sizes))]
    pool = space.array("object_distances", (max(sum(sizes), 1),), np.float32)
    for (thing, _), start in zip(objects, starts, strict=True):
        pool[start : start + thing.grid.distance.size] = thing.grid.distance.reshape(-1)  # type: ignore[no-untyped-call]
    rows = np.array([matrix.ravel() for matrix in matrices] or np.zeros((1, 16)), np.float32)
    dims = [(*thing.grid.dims, start) for (thing, _), start in zip(objects, starts, strict=True)] or [(0, 0, 0, 0)]
    return ObjectTable(
        count=len(objects),
        grid_from_volume=space.upload("object_grid_from_volume", rows.view(cl_types.float16)[:, 0]),
        dims=space.upload("object_dims", np.array(dims, np.int32).view(cl_types.int4)[:, 0]),
        distances=pool,
        cell_m=tuple(float(1 / np.linalg.norm(matrix[0, :3])) for matrix in matrices),
    )
