"""Meshes and poses for tests."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import trimesh
from numpy.typing import ArrayLike, NDArray

from server.scene.mesh import Mesh, load_mesh
from tests.data import data_folder


def mesh_of(vertices: ArrayLike, triangles: ArrayLike, colors: ArrayLike | None = None) -> Mesh:
    """A mesh as given, unchecked: normals point to +z unless a triangle says otherwise."""
    vertices = np.asarray(vertices, np.float32).reshape(-1, 3)
    triangles = np.asarray(triangles, np.int32).reshape(-1, 3)
    normals = np.tile(np.array([0, 0, 1], np.float32), (len(vertices), 1))
    a, b, c = (vertices[triangles[:, k]].astype(np.float64) for k in range(3))
    crosses = np.cross(b - a, c - a)
    lengths = np.linalg.norm(crosses, axis=1, keepdims=True)
    for k in range(3):
        normals[triangles[:, k]] = np.where(lengths > 0, crosses / np.where(lengths > 0, lengths, 1), (0, 0, 1))
    colors = np.full_like(vertices, 0.5) if colors is None else np.asarray(colors, np.float32).reshape(-1, 3)
    return Mesh(vertices, triangles, colors, normals, "y")


def soup_of(corners: ArrayLike) -> Mesh:
    """A mesh of separate triangles [t, 3, 3]; the red of triangle i is i / 1024."""
    corners = np.asarray(corners, np.float64).reshape(-1, 3, 3)
    colors = np.repeat(np.arange(len(corners)) / 1024, 9).reshape(-1, 3)
    return mesh_of(corners, np.arange(3 * len(corners)), colors)


def shape_of(shape: trimesh.Trimesh) -> Mesh:
    """One of trimesh's shapes, through the loader."""
    return load_mesh(shape.export(file_type="ply"), "ply")


def mesh_file(path: Path) -> Mesh:
    """The mesh in a file."""
    return load_mesh(path.read_bytes(), path.suffix[1:])


def public_mesh(name: str) -> Mesh:
    """A mesh of the public data."""
    return mesh_file(data_folder(f"mesh/{name}"))


def pose(
    translation: ArrayLike, axis: ArrayLike = (1.0, 0.0, 0.0), angle_rad: float = 0.0, scale: float = 1.0
) -> NDArray[np.float64]:
    """[4, 4] scale, then rotation about `axis`, then translation."""
    matrix = trimesh.transformations.rotation_matrix(angle_rad, axis)
    matrix[:3, :3] *= scale
    matrix[:3, 3] = translation
    return matrix
