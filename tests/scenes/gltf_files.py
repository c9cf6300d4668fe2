"""glTF files put together by hand, and what is expected of every mesh that is read."""

from __future__ import annotations

import base64
import json
import struct
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from server.scene.materials import Texture
from server.scene.mesh import Mesh

QUAD = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], np.float32)


QUAD_UV = np.array([[0.25, 0.75], [0.75, 0.75], [0.75, 0.25], [0.25, 0.25]], np.float32)


TWO = np.array([0, 1, 2, 0, 2, 3], np.uint32)


Json = dict[str, Any]


class Gltf:
    """A glTF file put together by hand."""

    def __init__(self) -> None:
        self.header: Json = {"asset": {"version": "2.0"}, "accessors": [], "bufferViews": [], "scene": 0}
        self.binary = b""

    def view(self, content: bytes) -> int:
        self.header["bufferViews"].append({"buffer": 0, "byteOffset": len(self.binary), "byteLength": len(content)})
        self.binary += content + b"\0" * (-len(content) % 4)
        return len(self.header["bufferViews"]) - 1

    def accessor(self, values: NDArray[Any]) -> int:
        kinds = {"float32": 5126, "uint32": 5125, "uint16": 5123, "uint8": 5121}
        shapes = {(): "SCALAR", (2,): "VEC2", (3,): "VEC3", (4,): "VEC4"}
        entry = {"bufferView": self.view(values.tobytes()), "count": len(values)}
        entry |= {"componentType": kinds[str(values.dtype)], "type": shapes[values.shape[1:]]}
        self.header["accessors"].append(entry)
        return len(self.header["accessors"]) - 1

    def quad(self, material: Json | None = None, **attributes: NDArray[Any]) -> Json:
        """One mesh, a square in the xy plane; returns its primitive."""
        primitive: Json = {"attributes": {"POSITION": self.accessor(QUAD)}, "indices": self.accessor(TWO)}
        primitive["attributes"] |= {name: self.accessor(values) for name, values in attributes.items()}
        if material is not None:
            self.header["materials"] = [{"pbrMetallicRoughness": material}]
            primitive["material"] = 0
        self.header |= {"meshes": [{"primitives": [primitive]}]}
        self.nodes({"mesh": 0})
        return primitive

    def texture(self, picture: NDArray[np.uint8], kind: str = ".png") -> Json:
        """A base colour texture of an RGB or RGBA picture."""
        order = cv2.COLOR_RGB2BGR if picture.shape[2] == 3 else cv2.COLOR_RGBA2BGRA
        done, encoded = cv2.imencode(kind, cv2.cvtColor(picture, order))
        assert done
        mime = {".png": "image/png", ".jpg": "image/jpeg"}[kind]
        self.header["images"] = [{"bufferView": self.view(encoded.tobytes()), "mimeType": mime}]
        self.header["textures"] = [{"source": 0}]
        return {"baseColorTexture": {"index": 0}}

    def nodes(self, *nodes: Json, roots: tuple[int, ...] = (0,)) -> None:
        self.header |= {"nodes": list(nodes), "scenes": [{"nodes": list(roots)}]}

    def glb(self) -> bytes:
        self.header["buffers"] = [{"byteLength": len(self.binary)}]
        text = json.dumps(self.header).encode()
        text += b" " * (-len(text) % 4)
        chunks = struct.pack("<II", len(text), 0x4E4F534A) + text
        chunks += struct.pack("<II", len(self.binary), 0x004E4942) + self.binary
        return b"glTF" + struct.pack("<II", 2, 12 + len(chunks)) + chunks

    def gltf(self) -> bytes:
        uri = "data:application/octet-stream;base64," + base64.b64encode(self.binary).decode()
        self.header["buffers"] = [{"byteLength": len(self.binary), "uri": uri}]
        return json.dumps(self.header).encode()


def linear(srgb: Any) -> NDArray[np.float64]:
    srgb = np.asarray(srgb, np.float64)
    return np.where(srgb <= 0.04045, srgb / 12.92, ((srgb + 0.055) / 1.055) ** 2.4)


def assert_well_formed(mesh: Mesh) -> None:
    for array, dtype in (
        (mesh.vertices, np.float32),
        (mesh.triangles, np.int32),
        (mesh.vertex_colors, np.float32),
        (mesh.normals, np.float32),
    ):
        assert array.dtype == dtype
        assert array.shape[1] == 3
        assert np.isfinite(array).all()
    assert len(mesh.vertices) == len(mesh.vertex_colors) == len(mesh.normals)
    assert set(np.unique(mesh.triangles)) == set(range(len(mesh.vertices)))
    assert mesh.vertex_colors.min() >= 0
    assert mesh.vertex_colors.max() <= 1
    np.testing.assert_allclose(np.linalg.norm(mesh.normals, axis=1), 1, atol=1e-6)


def shown_texture(mesh: Mesh) -> Texture:
    texture = mesh.materials[0].color_texture
    assert texture is not None
    return texture


def color_uv(mesh: Mesh) -> dict[tuple[float, ...], NDArray[np.float32]]:
    """Base colour coordinates by the place of their vertex."""
    assert mesh.uv is not None
    return {tuple(v): uv[:2] for v, uv in zip(mesh.vertices.tolist(), mesh.uv, strict=True)}
