"""One mesh as the device has it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pyopencl as cl
import pyopencl.array as cl_array
from numpy.typing import NDArray

from server.opencl.engine import Engine
from server.scene.mesh import Mesh
from server.stages.voxelize import DistanceGrid, voxelize


@dataclass(frozen=True)
class VirtualObject:
    """A mesh's device arrays and its distance grid, made once on load. Moving it only changes a matrix."""

    vertices: cl_array.Array
    """[v, 3] float32 model metres."""
    triangles: cl_array.Array
    """[t, 3] int32."""
    attributes: cl_array.Array
    """[v, 6] float32: unit normal in model axes, linear base colour."""
    bounds: tuple[NDArray[np.float64], NDArray[np.float64]]
    """Lowest and highest corner of the box around the vertices, model metres."""
    grid: DistanceGrid

    @classmethod
    def upload(cls, engine: Engine, mesh: Mesh, cells: int = 64) -> VirtualObject:
        """Copy `mesh` to the device and voxelise it, `cells` along the longest side of its grid."""
        vertices = cl_array.to_device(engine.queue, mesh.vertices)
        triangles = cl_array.to_device(engine.queue, mesh.triangles)
        attributes = np.hstack([mesh.normals, mesh.vertex_colors])
        grid = voxelize(engine, vertices, triangles, mesh.bounds, cells)
        return cls(vertices, triangles, cl_array.to_device(engine.queue, attributes), mesh.bounds, grid)

    @property
    def bytes_held(self) -> int:
        """Device memory."""
        return int(sum(array.nbytes for array in self._arrays))

    def release(self) -> None:
        """Give the device memory back; the object must not be drawn any more."""
        for array in self._arrays:
            if isinstance(array.base_data, cl.MemoryObject):
                array.base_data.release()

    @property
    def _arrays(self) -> tuple[cl_array.Array, ...]:
        return self.vertices, self.triangles, self.attributes, self.grid.distance
