"""The exact room of `mitsuba_room`: its meshes for rays, and which picture shows a point of it."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from protocol.frames import CameraModel

Floats = NDArray[np.float64]

UNSEEN = -1
SAME_DEPTH_M = 0.01
"""A hit is seen by a camera whose exact depth there is nearer to it than this."""


class ExactMeshes:
    """Meshes for rays, through Open3D (Embree)."""

    def __init__(self, paths: list[Path]) -> None:
        """Raises ImportError where Open3D is not installed."""
        import open3d

        self._open3d: Any = open3d
        self._scene = self._open3d.t.geometry.RaycastingScene(nthreads=2)
        self.meshes: list[tuple[NDArray[np.int64], Floats]] = []
        """Triangles and vertex normals of each."""
        corners: list[Floats] = []
        for path in paths:
            mesh = self._open3d.io.read_triangle_mesh(str(path))
            mesh.compute_vertex_normals()
            self._scene.add_triangles(self._open3d.t.geometry.TriangleMesh.from_legacy(mesh))
            triangles, normals = np.asarray(mesh.triangles), np.asarray(mesh.vertex_normals)
            self.meshes.append((triangles.astype(np.int64), normals.astype(np.float64)))
            corners += [mesh.get_min_bound(), mesh.get_max_bound()]
        self.bounds: Floats = np.array([np.min(corners, axis=0), np.max(corners, axis=0)], np.float64)
        """[2, 3] least and greatest coordinates of all."""

    def cast(self, origins: Floats, directions: Floats) -> dict[str, NDArray[Any]]:
        """What rays [n, 3] first meet, by Open3D's names."""
        rays = self._open3d.core.Tensor(np.hstack([origins, directions]).astype(np.float32))
        return {name: values.numpy() for name, values in self._scene.cast_rays(rays).items()}


@dataclass(frozen=True)
class Views:
    """Cameras with the exact depth of what they see."""

    camera: CameraModel
    poses: list[Floats]
    """World from camera, [4, 4] each."""
    depth_m: Floats
    """[>= poses, h, w]"""

    def sources(self, points: Floats, first: int = 0) -> NDArray[np.int32]:
        """[n] picture element (view * h * w + pixel) that shows each room point [n, 3]: of view `first` if it can,
        else of any other; UNSEEN where none does."""
        height, width = self.depth_m.shape[1:]
        found = np.full(len(points), UNSEEN, np.int32)
        for index in [first, *(i for i in range(len(self.poses)) if i != first)]:
            pose, camera = self.poses[index], self.camera
            x, y, z = ((points - pose[:3, 3]) @ pose[:3, :3]).T
            ahead = z > 0.05
            u = np.rint(np.where(ahead, x / np.where(ahead, z, 1) * camera.fx + camera.cx, -1)).astype(int)
            v = np.rint(np.where(ahead, y / np.where(ahead, z, 1) * camera.fy + camera.cy, -1)).astype(int)
            inside = ahead & (u >= 0) & (v >= 0) & (u < width) & (v < height)
            depth = self.depth_m[index][np.clip(v, 0, height - 1), np.clip(u, 0, width - 1)]
            new = inside & (np.abs(depth - z) < SAME_DEPTH_M) & (found == UNSEEN)
            found[new] = index * height * width + v[new] * width + u[new]
        return found
