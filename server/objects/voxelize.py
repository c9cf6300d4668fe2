"""Distance grids of virtual objects (thesis 7.2, fig. 7.5). Kernels: voxelize.cl."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pyopencl as cl
import pyopencl.array as cl_array
from numpy.typing import NDArray

from server.opencl.buffers import BufferDescription, StageBuffers
from server.opencl.engine import Engine, float16, int4

MARGIN_CELLS = 2
"""Free cells around the mesh, on every side."""
NEAR_CELLS = 1.65
"""Distances up to this many cells are measured to the triangles."""
LEAST_CELLS = 8
MOST_CELLS = 256
_SLAB = 8

Matrix = NDArray[np.float64]
Vector = NDArray[np.float64]


class VoxelizeBuffers(StageBuffers):
    """Device buffers of voxelization, [z, y, x]."""

    occupied = BufferDescription(np.int32)
    """1 for cells that a triangle touches."""
    near = BufferDescription(np.int32)
    """Distance to the triangles near a cell, as the bits of a float."""
    squared = BufferDescription(np.int32)
    other_squared = BufferDescription(np.int32)
    """Squared distances before and after each axis."""


@dataclass(frozen=True)
class DistanceGrid:
    """Distance of each cell's centre from the mesh."""

    distance: cl_array.Array
    """[z, y, x] float32, cells: up to NEAR_CELLS to the nearest triangle; farther away to the centre of the nearest
    cell that a triangle touches, which is exact to half a cell's diagonal.
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


def voxelize(
    engine: Engine, vertices: cl_array.Array, triangles: cl_array.Array, bounds: tuple[Vector, Vector], cells: int = 64
) -> DistanceGrid:
    """Distance grid of a mesh: vertices [v, 3] float32, triangles [t, 3] int32, `cells` along its longest side.

    The distance array is the caller's to keep. Raises ValueError for a number of cells out of range.
    """
    dims, grid_from_model = place_grid(*bounds, cells)
    buffers, shape = engine.buffers(VoxelizeBuffers), dims[::-1]
    occupied, near = buffers.occupied.array(shape), buffers.near.array(shape)
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

    The box begins at the centre of cell MARGIN_CELLS on each axis and ends at the centre of a cell on its longest axis:
    walls along the axes then mark one layer of cells instead of two.
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

    Exact, axis by axis (Felzenszwalb and Huttenlocher). The array is valid until the next call.
    """
    buffers, (z, y, x), cells = engine.buffers(VoxelizeBuffers), occupied.shape, occupied.size
    one, other = buffers.squared.array(occupied.shape), buffers.other_squared.array(occupied.shape)
    spread = _kernel(engine, "spread_distance")
    engine.launch(_kernel(engine, "seed_distance"), (y * z,), int4(x, y, z, 0), occupied, one)
    engine.launch(spread, (cells,), cells, y, x, one, other)
    engine.launch(spread, (cells,), cells, z, x * y, other, one)
    return one
