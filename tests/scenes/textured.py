"""A small textured asset made by code, as the files that people have: GLB, and OBJ with its materials."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from client.objects import glb

FACE_COLORS = np.array(
    [[200, 40, 40], [40, 200, 40], [40, 40, 200], [200, 200, 40], [40, 200, 200], [200, 40, 200]], np.uint8
)
"""sRGB of the sides towards +x, -x, +y, -y, +z, -z."""
ROUGHNESS = 0.5
_TILE_PX = 32


def atlas() -> NDArray[np.uint8]:
    """[64, 96, 3] sRGB: the sides' colours as tiles, three in a row, with a black mark in each upper left corner."""
    image = np.zeros((2 * _TILE_PX, 3 * _TILE_PX, 3), np.uint8)
    for side, color in enumerate(FACE_COLORS):
        row, column = divmod(side, 3)
        tile = image[row * _TILE_PX : (row + 1) * _TILE_PX, column * _TILE_PX : (column + 1) * _TILE_PX]
        tile[:] = color
        tile[2:10, 2:10] = 0
    return image


def cube() -> tuple[NDArray[np.float32], NDArray[np.uint32], NDArray[np.float32]]:
    """Vertices [24, 3] of a cube of 1 m standing on y = 0, triangles [12, 3], coordinates [24, 2] (glTF's)."""
    vertices, uv = [], []
    for side in range(6):
        axis, sign = side // 2, 1 - 2 * (side % 2)
        up = np.eye(3)[1 if axis != 1 else 2]
        out = sign * np.eye(3)[axis]
        right = np.cross(up, out)
        row, column = divmod(side, 3)
        for u, v in ((0, 0), (0, 1), (1, 1), (1, 0)):
            vertices.append(0.5 * out + (u - 0.5) * right + (0.5 - v) * up + (0, 0.5, 0))
            uv.append(((column + u) / 3, (row + v) / 2))
    corners = np.arange(24).reshape(6, 4)
    triangles = np.concatenate([corners[:, [0, 1, 2]], corners[:, [0, 2, 3]]])
    return np.array(vertices, np.float32), triangles.astype(np.uint32), np.array(uv, np.float32)


def write_glb(folder: Path) -> Path:
    """`cube.glb`, its texture inside."""
    vertices, triangles, uv = cube()
    document: dict[str, Any] = {"asset": {"version": "2.0"}, "scene": 0, "scenes": [{"nodes": [0]}]}
    document |= {"nodes": [{"mesh": 0}]}
    body = bytearray()
    image = glb.add_image(document, body, _png(), folder / "cube.png")
    attributes = {
        "POSITION": glb.add_array(document, body, vertices, bounds=True),
        "TEXCOORD_0": glb.add_array(document, body, uv),
    }
    primitive = {"attributes": attributes, "indices": glb.add_array(document, body, triangles.ravel()), "material": 0}
    surface = {"baseColorTexture": {"index": 0}, "roughnessFactor": ROUGHNESS, "metallicFactor": 0.0}
    document |= {
        "meshes": [{"primitives": [primitive]}],
        "textures": [{"source": image}],
        "materials": [{"pbrMetallicRoughness": surface}],
    }
    path = folder / "cube.glb"
    path.write_bytes(glb.to_bytes(document, body))
    return path


def write_obj(folder: Path) -> Path:
    """`cube.obj`, `cube.mtl` and `cube.png`."""
    vertices, triangles, uv = cube()
    lines = ["mtllib cube.mtl", "usemtl atlas"]
    lines += [f"v {x:.9g} {y:.9g} {z:.9g}" for x, y, z in vertices]
    lines += [f"vt {u:.9g} {1 - v:.9g}" for u, v in uv]
    lines += ["f " + " ".join(f"{k + 1}/{k + 1}" for k in triangle) for triangle in triangles]
    (folder / "cube.png").write_bytes(_png())
    (folder / "cube.mtl").write_text(f"newmtl atlas\nKd 1 1 1\nPr {ROUGHNESS}\nmap_Kd cube.png\n")
    path = folder / "cube.obj"
    path.write_text("\n".join(lines) + "\n")
    return path


def _png() -> bytes:
    return cv2.imencode(".png", cv2.cvtColor(atlas(), cv2.COLOR_RGB2BGR))[1].tobytes()
