"""A mesh on the device."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import pyopencl as cl
import pyopencl.array as cl_array
from numpy.typing import NDArray

from server.objects.surface_points import SurfacePoints, deal_points
from server.objects.voxelize import DistanceGrid, voxelize
from server.opencl.engine import Engine
from server.scene.mesh import Mesh
from server.scene.mipmaps import MaterialTables, material_tables


@dataclass(frozen=True)
class VirtualObject:
    """A mesh's device arrays and its distance grid, made once on load. Moving it only changes a matrix."""

    vertices: cl_array.Array
    """[v, 3] float32 model metres."""
    triangles: cl_array.Array
    """[t, 3] int32."""
    attributes: cl_array.Array
    """[v, 12] float32: unit normal in model axes, 0; linear base colour, 0; texture coordinates of base colour and of
    roughness and metalness.
    """
    material_of: cl_array.Array
    """[t] int32: row of `tables.materials`."""
    texels: cl_array.Array
    """[n, 4] uint8: all mip levels of all textures."""
    tables: MaterialTables
    """Materials and textures without their texels, on the host."""
    bounds: tuple[NDArray[np.float64], NDArray[np.float64]]
    """Lowest and highest corner of the box around the vertices, model metres."""
    grid: DistanceGrid
    surface_points: SurfacePoints
    """Points at which the light that it reflects is computed."""

    @classmethod
    def upload(cls, engine: Engine, mesh: Mesh, cells: int = 64) -> VirtualObject:
        """Copy `mesh` to the device and voxelise it, `cells` along the longest side of its grid."""
        tables = material_tables(mesh.materials)
        texels = tables.texels if len(tables.texels) else np.zeros((1, 4), np.uint8)
        vertices, triangles, attributes, material_of, texels_there = (
            cl_array.to_device(engine.queue, array)
            for array in (mesh.vertices, mesh.triangles, _attributes(mesh), mesh.material_of, texels)
        )
        grid = voxelize(engine, vertices, triangles, mesh.bounds, cells)
        thing = cls(
            vertices,
            triangles,
            attributes,
            material_of,
            texels_there,
            replace(tables, texels=np.zeros((0, 4), np.uint8)),
            mesh.bounds,
            grid,
            deal_points(engine, mesh, grid),
        )
        engine.device.memory.add(thing)
        return thing

    @property
    def bytes_held(self) -> int:
        """Device memory."""
        return int(sum(array.nbytes for array in self._arrays))

    def release(self) -> None:
        """Free the device memory. The object must not be drawn afterwards."""
        for array in self._arrays:
            if isinstance(array.base_data, cl.MemoryObject):
                array.base_data.release()

    @property
    def _arrays(self) -> tuple[cl_array.Array, ...]:
        return self.vertices, self.triangles, self.attributes, self.material_of, self.texels, self.grid.distance


def _attributes(mesh: Mesh) -> NDArray[np.float32]:
    """[v, 12], see VirtualObject."""
    attributes = np.zeros((len(mesh.vertices), 12), np.float32)
    attributes[:, :3], attributes[:, 4:7], attributes[:, 8:] = mesh.normals, mesh.vertex_colors, mesh.texture_uv
    return attributes
