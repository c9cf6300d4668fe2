"""Writes a scene's mesh as PLY and GLB with trimesh. Equal meshes give equal bytes.

PLY: world axes, metres. GLB: the same numbers under a node that rotates the world upright (+y up), as glTF requires.
Both have normals and sRGB vertex colours; the GLB uses KHR_materials_unlit, since the colours include the lighting.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import trimesh

from protocol.messages import MeshFormat
from server.meshing.scene_mesh import SceneMesh

_UNLIT = "KHR_materials_unlit"


def mesh_files(mesh: SceneMesh) -> dict[MeshFormat, bytes]:
    """A mesh in every format."""
    return {"ply": ply_bytes(mesh), "glb": glb_bytes(mesh)}


def ply_bytes(mesh: SceneMesh) -> bytes:
    """Binary little-endian PLY: x y z, nx ny nz, red green blue alpha; triangles."""
    data: bytes = _as_trimesh(mesh).export(file_type="ply", vertex_normal=True)
    return data


def glb_bytes(mesh: SceneMesh) -> bytes:
    """GLB 2.0: one node with the rotation into glTF's axes, one mesh, one material without lighting."""
    upright = np.eye(4)
    upright[:3, :3] = mesh.gltf_from_world
    scene: Any = trimesh.Scene()
    scene.add_geometry(_as_trimesh(mesh), node_name="scene", geom_name="scene", transform=upright)
    data: bytes = scene.export(
        file_type="glb", include_normals=True, unitize_normals=False, tree_postprocessor=_add_unlit_material
    )
    return data


def _as_trimesh(mesh: SceneMesh) -> Any:
    return trimesh.Trimesh(
        vertices=mesh.vertices,
        faces=mesh.triangles,
        vertex_normals=mesh.normals,
        vertex_colors=np.column_stack([mesh.colors, np.full(len(mesh.colors), 255, np.uint8)]),
        process=False,
        validate=False,
    )


def _add_unlit_material(tree: dict[str, Any]) -> None:
    """A viewer without the extension shows a rough white surface instead of glTF's default metal."""
    rough = {"baseColorFactor": [1.0, 1.0, 1.0, 1.0], "metallicFactor": 0.0, "roughnessFactor": 1.0}
    tree["materials"] = [{"pbrMetallicRoughness": rough, "extensions": {_UNLIT: {}}}]
    tree["extensionsUsed"] = [_UNLIT]
    for mesh in tree["meshes"]:
        for primitive in mesh["primitives"]:
            primitive["material"] = 0
