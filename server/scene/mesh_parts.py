"""Reads the parts of a mesh file with trimesh: placed by the scene graph, with linear colours.

Vertex colours are sRGB in every format, including glTF's COLOR_0 (documented for the command line); factors are linear.
"""

from __future__ import annotations

import io
import re
import warnings
from dataclasses import dataclass, replace
from threading import Lock
from typing import Any

import numpy as np
import trimesh
from numpy.typing import NDArray

from server.scene.colors import linear_from_srgb, unit_range
from server.scene.gltf import COLOR_UV, SURFACE_UV, prepare_gltf
from server.scene.gltf_materials import GltfMaterial, TextureUse
from server.scene.limits import MAX_TRIANGLES, MAX_VERTICES, MeshError
from server.scene.materials import MATTE, Beyond, Material, Texture

DEFAULT_BASE_COLOR = 0.8
_FARTHEST_UV = 1e6
FORMATS = ("glb", "gltf", "obj", "ply", "stl")

_loading = Lock()  # warnings.catch_warnings is not thread-safe


@dataclass(frozen=True)
class MeshPart:
    """Triangles of one geometry at one node of the scene graph, not validated, in model metres."""

    vertices: NDArray[np.float64]
    """[v, 3]"""
    triangles: NDArray[np.int64]
    """[t, 3] vertex indices, possibly out of range."""
    colors: NDArray[np.float32]
    """[v, 3] linear base colour without its texture."""
    normals: NDArray[np.float64] | None
    """[v, 3] of any length; None if the file has none."""
    uv: NDArray[np.float32]
    """[v, 4] texture coordinates of base colour, and of roughness and metalness."""
    material: Material = MATTE


def read_parts(data: bytes, file_format: str) -> tuple[list[MeshPart], tuple[str, ...]]:
    """All parts of a file of one of FORMATS, and notes on what was not read. Raises MeshError."""
    if not data:
        raise MeshError(f"the {file_format} file is empty: export it again")
    with _loading, warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            return _read(data, file_format)
        except MeshError:
            raise
        except Exception as error:  # trimesh and the lines below raise various errors for damaged files
            reason = " ".join(f"{type(error).__name__} {error}".split())[:160]
            raise MeshError(f"not a readable {file_format} mesh: {reason}") from error


def _read(data: bytes, file_format: str) -> tuple[list[MeshPart], tuple[str, ...]]:
    materials: list[GltfMaterial] = []
    notes: tuple[str, ...] = ()
    if file_format in {"glb", "gltf"}:
        data, materials, notes = prepare_gltf(data)
    elif file_format == "obj":
        data, notes = _without_materials(data)
    else:
        _refuse_announced(data, file_format)
    scene: Any = trimesh.load_scene(io.BytesIO(data), file_type=file_format, process=False)
    places = [scene.graph[node] for node in scene.graph.nodes_geometry]
    meshes = [(matrix, scene.geometry[name]) for matrix, name in places]
    meshes = [(matrix, mesh) for matrix, mesh in meshes if isinstance(mesh, trimesh.Trimesh)]
    _refuse_oversized([mesh for _, mesh in meshes])
    return [_part(mesh, matrix, materials) for matrix, mesh in meshes], notes


def _without_materials(obj: bytes) -> tuple[bytes, tuple[str, ...]]:
    """Remove material references from an OBJ: they are in another file, and trimesh copies all vertices for each."""
    lines = obj.splitlines()
    kept = [line for line in lines if not line.lstrip().startswith((b"mtllib", b"usemtl"))]
    if len(kept) == len(lines):
        return obj, ()
    return b"\n".join(kept), ("the OBJ's materials are in another file and were not read: send a GLB for its colours",)


def _refuse_announced(data: bytes, file_format: str) -> None:
    """Refuse a PLY or binary STL by the counts in its header, before it is read."""
    vertices, triangles = 0, 0
    if file_format == "ply":
        header = data[: data.find(b"end_header") + 1][:65536]
        counts = dict(re.findall(rb"element\s+(vertex|face)\s+(\d{1,18})", header))
        vertices, triangles = int(counts.get(b"vertex", 0)), int(counts.get(b"face", 0))
    elif len(data) >= 84 and not data.lstrip().startswith(b"solid"):
        triangles = int.from_bytes(data[80:84], "little")
    if triangles > MAX_TRIANGLES or vertices > MAX_VERTICES:
        raise MeshError(
            f"the mesh has {triangles} triangles and {vertices or 3 * triangles} vertices, more than "
            f"{MAX_TRIANGLES} and {MAX_VERTICES}: simplify it"
        )


def _refuse_oversized(meshes: list[Any]) -> None:
    triangles = sum(len(mesh.faces) for mesh in meshes)
    if triangles > MAX_TRIANGLES or sum(len(mesh.vertices) for mesh in meshes) > MAX_VERTICES:
        raise MeshError(f"the mesh has {triangles} triangles, more than {MAX_TRIANGLES}: simplify it")


def _part(mesh: Any, matrix: NDArray[np.float64], materials: list[GltfMaterial]) -> MeshPart:
    vertices, triangles = np.asarray(mesh.vertices, np.float64), np.asarray(mesh.faces, np.int64)
    # Only normals from the file: the property itself would compute them.
    normals = mesh._cache.cache.get("vertex_normals")
    found = _material(mesh, materials)
    colors, (uv, material) = _base_colors(mesh, found), _texture_uv(mesh, found)
    if mesh.visual.kind == "face":  # one colour per triangle: duplicate the vertices
        safe = np.clip(triangles.reshape(-1), 0, len(vertices) - 1)
        vertices, colors, uv = vertices[safe], np.repeat(colors, 3, axis=0), uv[safe]
        normals = None if normals is None else normals[safe]
        triangles = np.arange(len(vertices)).reshape(-1, 3)
    vertices, triangles, normals = _placed(vertices, triangles, normals, np.asarray(matrix, np.float64))
    return MeshPart(vertices, triangles, colors, normals, uv, material)


def _placed(
    vertices: NDArray[np.float64],
    triangles: NDArray[np.int64],
    normals: NDArray[np.float64] | None,
    matrix: NDArray[np.float64],
) -> tuple[NDArray[np.float64], NDArray[np.int64], NDArray[np.float64] | None]:
    """The part transformed by its node's `matrix`; a reflection also reverses the winding."""
    with np.errstate(over="ignore", invalid="ignore"):
        linear = matrix[:3, :3]
        vertices = vertices @ linear.T + matrix[:3, 3]
        mirrored = np.linalg.det(linear) < 0
        if normals is not None:
            cofactors = np.stack([np.cross(linear[(k + 1) % 3], linear[(k + 2) % 3]) for k in range(3)])
            normals = np.asarray(normals, np.float64) @ cofactors.T * (-1.0 if mirrored else 1.0)
    return vertices, triangles[:, ::-1] if mirrored else triangles, normals


def _material(mesh: Any, materials: list[GltfMaterial]) -> GltfMaterial | None:
    """The part's material from prepare_gltf; None if the file names none."""
    name = str(getattr(getattr(mesh.visual, "material", None), "name", None))
    return materials[int(name)] if name.isdigit() and int(name) < len(materials) else None


def _base_colors(mesh: Any, material: GltfMaterial | None) -> NDArray[np.float32]:
    """[v, 3] linear (face colours: [t, 3]): material factor times vertex colours; grey if there are neither."""
    visual, count = mesh.visual, len(mesh.vertices)
    if visual.kind == "face":
        return linear_from_srgb(unit_range(np.asarray(visual.face_colors))[:, :3])
    if visual.kind == "vertex":
        return linear_from_srgb(unit_range(np.asarray(visual.vertex_colors))[:, :3])
    if material is None:
        return np.full((count, 3), DEFAULT_BASE_COLOR, np.float32)
    colors = np.tile(np.asarray(material.factor, np.float32), (count, 1))
    own = visual.vertex_attributes.get("color")
    if own is not None and len(own) == count:
        colors *= linear_from_srgb(unit_range(np.asarray(own))[:, :3])
    return colors


def _texture_uv(mesh: Any, found: GltfMaterial | None) -> tuple[NDArray[np.float32], Material]:
    """[v, 4] texture coordinates of the vertices, 0 if unused; and the material without textures that lack them."""
    uv = np.zeros((len(mesh.vertices), 4), np.float32)
    if found is None:
        return uv, MATTE
    material = found.material
    color = _changed_uv(mesh.vertex_attributes.get(COLOR_UV), found.color_use, material.color_texture, len(uv))
    surface = _changed_uv(mesh.vertex_attributes.get(SURFACE_UV), found.surface_use, material.surface_texture, len(uv))
    if color is not None:
        uv[:, :2] = color
    elif material.color_texture is not None:
        material = replace(material, color_texture=None)
    if surface is not None:
        uv[:, 2:] = surface
    elif material.surface_texture is not None:
        material = replace(material, surface_texture=None)
    return uv, material


def _changed_uv(
    given: NDArray[Any] | None, use: TextureUse | None, texture: Texture | None, count: int
) -> NDArray[np.float64] | None:
    """[count, 2] texture coordinates for the device: transformed, finite, and near 0 if the texture repeats.

    None without coordinates or texture.
    """
    if given is None or use is None or texture is None or np.shape(given) != (count, 2):
        return None
    # Integers are normalised; floats of any size are coordinates.
    values = given / np.iinfo(given.dtype).max if np.issubdtype(given.dtype, np.integer) else given.astype(np.float64)
    values = np.clip(np.nan_to_num(values), -_FARTHEST_UV, _FARTHEST_UV)
    values = values @ use.transform[:, :2].T + use.transform[:, 2]
    values = np.clip(np.nan_to_num(values), -_FARTHEST_UV, _FARTHEST_UV)
    repeats = np.array([beyond is not Beyond.CLAMP for beyond in texture.beyond])
    return values - np.where(repeats, 2 * np.floor(np.median(values, axis=0) / 2), 0.0)
