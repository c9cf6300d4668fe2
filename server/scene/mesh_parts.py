"""The parts of a mesh file as trimesh reads them: placed by the file's scene graph, coloured in linear light."""

from __future__ import annotations

import io
import warnings
from dataclasses import dataclass
from threading import Lock
from typing import Any

import numpy as np
import trimesh
from numpy.typing import NDArray

from server.scene.colors import linear_from_srgb, sample_texture, unit_range
from server.scene.gltf import BaseColor, prepare_gltf
from server.scene.limits import MAX_TRIANGLES, MAX_VERTICES, MeshError

DEFAULT_BASE_COLOR = 0.8
FORMATS = ("glb", "gltf", "obj", "ply", "stl")

_loading = Lock()  # warnings.catch_warnings changes what the whole process warns of


@dataclass(frozen=True)
class MeshPart:
    """Triangles of one geometry at one place of the scene graph, unchecked, in model metres."""

    vertices: NDArray[np.float64]
    """[v, 3]"""
    triangles: NDArray[np.int64]
    """[t, 3] vertex numbers, which may not exist."""
    colors: NDArray[np.float32]
    """[v, 3] linear base colour."""
    normals: NDArray[np.float64] | None
    """[v, 3] of any length; None where the file has none."""


def read_parts(data: bytes, file_format: str) -> tuple[list[MeshPart], tuple[str, ...]]:
    """Every part of a file of one of FORMATS, and notes on what was not read. Raises MeshError."""
    with _loading, warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            return _read(data, file_format)
        except MeshError:
            raise
        except Exception as error:  # whatever a damaged file makes trimesh or the lines below stumble over
            reason = " ".join(f"{type(error).__name__} {error}".split())[:160]
            raise MeshError(f"not a readable {file_format} mesh: {reason}") from error


def _read(data: bytes, file_format: str) -> tuple[list[MeshPart], tuple[str, ...]]:
    materials: list[BaseColor] = []
    notes: tuple[str, ...] = ()
    if file_format in {"glb", "gltf"}:
        data, materials, notes = prepare_gltf(data)
    elif file_format == "obj":
        data, notes = _without_materials(data)
    scene: Any = trimesh.load_scene(io.BytesIO(data), file_type=file_format, process=False)
    places = [scene.graph[node] for node in scene.graph.nodes_geometry]
    meshes = [(matrix, scene.geometry[name]) for matrix, name in places]
    meshes = [(matrix, mesh) for matrix, mesh in meshes if isinstance(mesh, trimesh.Trimesh)]
    _refuse_oversized([mesh for _, mesh in meshes])
    return [_part(mesh, matrix, materials) for matrix, mesh in meshes], notes


def _without_materials(obj: bytes) -> tuple[bytes, tuple[str, ...]]:
    """An OBJ less the materials it only names: they are in another file, and trimesh copies all vertices for each."""
    lines = obj.splitlines()
    kept = [line for line in lines if not line.lstrip().startswith((b"mtllib", b"usemtl"))]
    if len(kept) == len(lines):
        return obj, ()
    return b"\n".join(kept), ("the OBJ's materials are in another file and were not read: send a GLB for its colours",)


def _refuse_oversized(meshes: list[Any]) -> None:
    triangles = sum(len(mesh.faces) for mesh in meshes)
    if triangles > MAX_TRIANGLES or sum(len(mesh.vertices) for mesh in meshes) > MAX_VERTICES:
        raise MeshError(f"the mesh has {triangles} triangles, more than {MAX_TRIANGLES}: simplify it")


def _part(mesh: Any, matrix: NDArray[np.float64], materials: list[BaseColor]) -> MeshPart:
    vertices, triangles = np.asarray(mesh.vertices, np.float64), np.asarray(mesh.faces, np.int64)
    # Only what the file brought: the property itself would compute them.
    normals = mesh._cache.cache.get("vertex_normals")
    colors = _base_colors(mesh, materials)
    if mesh.visual.kind == "face":  # one colour a triangle: give each its own vertices
        safe = np.clip(triangles.reshape(-1), 0, len(vertices) - 1)
        vertices, colors = vertices[safe], np.repeat(colors, 3, axis=0)
        normals = None if normals is None else normals[safe]
        triangles = np.arange(len(vertices)).reshape(-1, 3)
    return _placed(vertices, triangles, colors, normals, np.asarray(matrix, np.float64))


def _placed(
    vertices: NDArray[np.float64],
    triangles: NDArray[np.int64],
    colors: NDArray[np.float32],
    normals: NDArray[np.float64] | None,
    matrix: NDArray[np.float64],
) -> MeshPart:
    """The part moved by its node's `matrix`; a mirroring one turns the triangles back round."""
    with np.errstate(over="ignore", invalid="ignore"):
        linear = matrix[:3, :3]
        vertices = vertices @ linear.T + matrix[:3, 3]
        mirrored = np.linalg.det(linear) < 0
        if normals is not None:
            cofactors = np.stack([np.cross(linear[(k + 1) % 3], linear[(k + 2) % 3]) for k in range(3)])
            normals = np.asarray(normals, np.float64) @ cofactors.T * (-1.0 if mirrored else 1.0)
    return MeshPart(vertices, triangles[:, ::-1] if mirrored else triangles, colors, normals)


def _base_colors(mesh: Any, materials: list[BaseColor]) -> NDArray[np.float32]:
    """[v, 3] linear (face colours: [t, 3]): material times texture times vertex colours; grey where there is none."""
    visual, count = mesh.visual, len(mesh.vertices)
    if visual.kind == "face":
        return linear_from_srgb(unit_range(np.asarray(visual.face_colors))[:, :3])
    if visual.kind == "vertex":
        return linear_from_srgb(unit_range(np.asarray(visual.vertex_colors))[:, :3])
    name = str(getattr(getattr(visual, "material", None), "name", None))
    if not name.isdigit() or int(name) >= len(materials):
        return np.full((count, 3), DEFAULT_BASE_COLOR, np.float32)
    colors = np.tile(np.asarray(materials[int(name)].factor, np.float32), (count, 1))
    texture, uv = materials[int(name)].texture, visual.uv
    if texture is not None and uv is not None and len(uv) == count:
        colors *= sample_texture(texture, np.asarray(uv, np.float64) * (1, -1) + (0, 1))
    own = visual.vertex_attributes.get("color")
    if own is not None and len(own) == count:
        colors *= linear_from_srgb(unit_range(np.asarray(own))[:, :3])
    return colors
