"""A small known scene for the tests of `--scene`."""

from __future__ import annotations

from typing import Any

import numpy as np
import trimesh
from numpy.typing import NDArray

from protocol.frames import CameraModel
from server.meshing.scene_mesh import SceneMesh

CAMERA = CameraModel(width=64, height=48, fx=60.0, fy=66.0, cx=31.5, cy=23.5)
GLTF_FROM_WORLD = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])
"""A world with +z up whose first camera looks along +y."""
SQUARE = np.array([[0, 0, 0], [1, 0, 0], [1, 2, 0], [0, 2, 0.0]], np.float32)


def square(gltf_from_world: NDArray[np.float64] = GLTF_FROM_WORLD) -> SceneMesh:
    """A floor: one by two metres, its upper face seen, half sRGB grey."""
    return SceneMesh(
        vertices=SQUARE,
        triangles=np.array([[0, 1, 2], [0, 2, 3]], np.int32),
        normals=np.array([[0, 0, 1], [0, 0, 1], [0, 0, 1], [0, 0, 0]], np.float32),
        colors=np.full((4, 3), 128, np.uint8),
        gltf_from_world=gltf_from_world,
    )


def cube_glb(picture: Any = None) -> bytes:
    """A GLB as trimesh writes it: a cube of one metre around (0, 0.5, 0), half a metre beside."""
    box = trimesh.creation.box((1, 1, 1))
    box.apply_translation((0, 0.5, 0))
    if picture is not None:
        material = trimesh.visual.material.PBRMaterial(baseColorTexture=picture, roughnessFactor=0.25)
        box.visual = trimesh.visual.TextureVisuals(uv=np.zeros((len(box.vertices), 2)), material=material)
    scene = trimesh.Scene()
    scene.add_geometry(box, transform=trimesh.transformations.translation_matrix((0.5, 0, 0)))
    return bytes(scene.export(file_type="glb"))
