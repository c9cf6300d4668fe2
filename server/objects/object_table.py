"""The table of the distance grids of virtual objects, for ray tracing. Rays: include/virtual_objects.clh."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import accumulate

import numpy as np
import pyopencl.array as cl_array
import pyopencl.cltypes as cl_types
from numpy.typing import NDArray

from server.objects.object_tree import FEW_OBJECTS, grid_boxes, tree_rows
from server.objects.virtual_object import VirtualObject
from server.opencl.buffers import BufferDescription, StageBuffers
from server.opencl.engine import Engine
from server.opencl.parts import Parts

Matrix = NDArray[np.float64]


class _Buffers(StageBuffers):
    rows = BufferDescription(np.uint8)
    """ObjectTable.rows."""
    distances = BufferDescription(np.float32)
    """ObjectTable.distances of several meshes."""


@dataclass(frozen=True)
class ObjectTable:
    """What `trace_objects` of virtual_objects.clh takes. The arrays are valid until the next table."""

    count: int
    rows: Parts
    """`grid_from_volume` and `dims`, in one buffer."""
    distances: cl_array.Array
    """All distance grids, each once, one after the other; float32, cells."""
    cell_m: tuple[float, ...]
    """Side of each object's cells in volume metres: the distance from its surface at which a ray must start."""

    @property
    def grid_from_volume(self) -> cl_array.Array:
        """[count] float16: row-major 4x4, volume metres to cells; for many objects followed by a tree of their
        boxes."""
        return self.rows.array("grid_from_volume")

    @property
    def dims(self) -> cl_array.Array:
        """[count] int4: cells in x, y, z, and where the object's distances begin in the pool."""
        return self.rows.array("dims")


def object_table(engine: Engine, objects: Sequence[tuple[VirtualObject, Matrix]]) -> ObjectTable:
    """The table of `objects`, each with its `volume_from_model` [4, 4]: rotation, uniform scale and translation.

    A mesh that is placed several times is stored once; distances are copied only when the set of meshes changes.
    """
    count = len(objects)
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
        rows=engine.buffers(_Buffers).rows.refresh_parts(
            {"grid_from_volume": table.view(cl_types.float16)[:, 0], "dims": dims.view(cl_types.int4)[:, 0]},
        ),
        distances=pool,
        cell_m=tuple((1 / np.linalg.norm(matrices[:, 0, :3], axis=1)).tolist()),
    )


class _PooledGrids:
    """The grids whose distances are in an engine's pool, in their order."""

    grids: tuple[cl_array.Array, ...] = ()


def _gather_distances(engine: Engine, grids: list[cl_array.Array]) -> tuple[cl_array.Array, dict[int, int]]:
    """All `grids`, each once, one after the other, and where each begins, by its id; a single one is not copied."""
    unique = tuple({id(grid): grid for grid in grids}.values())
    first = accumulate((grid.size for grid in unique), initial=0)
    starts = {id(grid): start for grid, start in zip(unique, first, strict=False)}
    if len(unique) == 1:
        return unique[0], starts
    total = sum(grid.size for grid in unique)
    if total >= 1 << 31:
        raise ValueError(f"the objects' distance grids have {total} cells, more than 2^31: place fewer objects")
    pooled, buffer = engine.state(_PooledGrids), engine.buffers(_Buffers).distances
    before, pool = buffer.current, buffer.array((max(total, 1),))
    if pool is not before or [*map(id, pooled.grids)] != [*map(id, unique)]:
        for grid in unique:
            engine.copy_into(pool, 4 * starts[id(grid)], grid)
        pooled.grids = unique
    return pool, starts
