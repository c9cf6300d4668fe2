"""The baseline of compositing: virtual objects pasted into the picture, lit, without a shadow anywhere.

They are shaded with the whole light, as if nothing stood near them, and change nothing but the pixels they cover. What
they cover, and their normals, come from the exact meshes by Open3D (Embree), so nothing of the project's renderer is in
it.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from protocol.frames import CameraModel
from server.maths.sh import lambert_transfer
from server.shading.composite import srgb_codes
from tests.bench.light.environment import bands_of
from tests.bench.rendering.flip import Codes

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]


class ObjectNormals:
    """Smooth normals of meshes in world coordinates, where a camera sees them."""

    def __init__(self, meshes: list[Path]) -> None:
        """Raises ImportError where Open3D is not installed."""
        import open3d

        self._open3d: Any = open3d
        self._scene = open3d.t.geometry.RaycastingScene(nthreads=2)
        self._parts: list[tuple[NDArray[np.int64], Floats]] = []
        for path in meshes:
            mesh = open3d.io.read_triangle_mesh(path)
            mesh.compute_vertex_normals()
            self._scene.add_triangles(open3d.t.geometry.TriangleMesh.from_legacy(mesh))
            self._parts.append((np.asarray(mesh.triangles, np.int64), np.asarray(mesh.vertex_normals, np.float64)))

    def seen(self, camera: CameraModel, world_from_camera: Floats) -> Floats:
        """[h, w, 3] unit, world axes, (0, 0, 0) where no mesh is seen; nothing real hides them."""
        v, u = np.mgrid[: camera.height, : camera.width]
        rays = np.stack([(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, np.ones(u.shape)], axis=-1)
        directions = rays @ world_from_camera[:3, :3].T
        origins = np.broadcast_to(world_from_camera[:3, 3], directions.shape)
        tensor = self._open3d.core.Tensor(np.concatenate([origins, directions], axis=-1).astype(np.float32))
        answer = {name: values.numpy() for name, values in self._scene.cast_rays(tensor).items()}
        normals = np.zeros(directions.shape)
        for number, (triangles, of_vertices) in enumerate(self._parts):
            here = answer["geometry_ids"] == number
            corners = of_vertices[triangles[answer["primitive_ids"][here]]]
            across, along = answer["primitive_uvs"][here].astype(np.float64).T[..., None]
            normals[here] = (1 - across - along) * corners[:, 0] + across * corners[:, 1] + along * corners[:, 2]
        unit: Floats = normals / np.maximum(np.linalg.norm(normals, axis=-1, keepdims=True), 1e-12)
        return unit


def pasted(shown: Codes, mask: Bools, normals: Floats, albedo: NDArray[np.floating], light: Floats) -> Codes:
    """[h, w, 3] sRGB codes of the camera's picture `shown` with Lambertian objects over it.

    mask [h, w]; normals, albedo [h, w, 3]; light [bands^2, 3] radiance in the units of the linear picture.
    """
    irradiance = lambert_transfer(normals[mask], bands_of(light)) @ light
    picture = shown.copy()
    picture[mask] = srgb_codes(np.asarray(albedo[mask], np.float64) * np.maximum(irradiance, 0.0))
    return picture
