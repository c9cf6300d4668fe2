"""Encodes a mesh for transfer from a child process, and decodes it with full validation: the child is not trusted."""

from __future__ import annotations

from typing import Any, Literal

import msgspec
import numpy as np
from msgspec import Struct
from numpy.typing import NDArray

from server.scene.limits import MAX_COORDINATE_M, MAX_KEPT_PIXELS, MAX_KEPT_SIDE, MAX_TRIANGLES, MAX_VERTICES, MeshError
from server.scene.materials import Beyond, Material, Texture
from server.scene.mesh import Mesh

MAX_NOTES = 1000
MAX_MATERIALS = 20_000
MAX_PACKED_BYTES = 16 * MAX_TRIANGLES + 52 * MAX_VERTICES + 8 * MAX_KEPT_PIXELS + (64 << 20)


class _Texture(Struct, array_like=True):
    width: int
    height: int
    image: memoryview
    alpha: memoryview | None
    beyond: tuple[int, int]


class _Material(Struct, array_like=True):
    roughness: float
    metalness: float
    color_texture: int | None
    surface_texture: int | None
    cutoff: float | None
    opacity: float


class _Mesh(Struct, array_like=True):
    vertices: memoryview
    triangles: memoryview
    vertex_colors: memoryview
    normals: memoryview
    up_axis: Literal["y", "z"]
    notes: tuple[str, ...]
    uv: memoryview | None
    triangle_materials: memoryview | None
    materials: tuple[_Material, ...]
    textures: tuple[_Texture, ...]


def mesh_to_bytes(mesh: Mesh) -> bytes:
    """Encode a mesh. A texture that several materials share is written once."""
    textures = list(dict.fromkeys(t for m in mesh.materials for t in (m.color_texture, m.surface_texture) if t))
    numbers = {texture: k for k, texture in enumerate(textures)}
    packed = _Mesh(
        vertices=_raw(mesh.vertices),
        triangles=_raw(mesh.triangles),
        vertex_colors=_raw(mesh.vertex_colors),
        normals=_raw(mesh.normals),
        up_axis=mesh.up_axis,
        notes=mesh.notes[:MAX_NOTES],
        uv=None if mesh.uv is None else _raw(mesh.uv),
        triangle_materials=None if mesh.triangle_materials is None else _raw(mesh.triangle_materials),
        materials=tuple(_packed(material, numbers) for material in mesh.materials),
        textures=tuple(
            _Texture(
                width=t.image.shape[1],
                height=t.image.shape[0],
                image=_raw(t.image),
                alpha=None if t.alpha is None else _raw(t.alpha),
                beyond=(int(t.beyond[0]), int(t.beyond[1])),
            )
            for t in textures
        ),
    )
    return msgspec.msgpack.encode(packed)


def mesh_from_bytes(data: bytes | bytearray) -> Mesh:
    """Decode and validate a mesh. Raises MeshError for invalid data or exceeded limits."""
    try:
        packed = msgspec.msgpack.decode(data, type=_Mesh)
        return _unpacked(packed)
    except (msgspec.MsgspecError, UnicodeDecodeError, ValueError) as error:
        raise MeshError(f"the mesh reader's answer is not a valid mesh: {error}") from error


def _packed(material: Material, numbers: dict[Texture, int]) -> _Material:
    def number(texture: Texture | None) -> int | None:
        return None if texture is None else numbers[texture]

    return _Material(
        roughness=material.roughness,
        metalness=material.metalness,
        color_texture=number(material.color_texture),
        surface_texture=number(material.surface_texture),
        cutoff=material.cutoff,
        opacity=material.opacity,
    )


def _unpacked(packed: _Mesh) -> Mesh:
    vertices = _floats("vertices", packed.vertices, 3, MAX_COORDINATE_M)
    count = len(vertices)
    triangles = _rows("triangles", packed.triangles, np.int32, 3)
    _require(0 < count <= MAX_VERTICES and 0 < len(triangles) <= MAX_TRIANGLES, "it is empty or too large")
    _require_numbers("triangles", triangles, count)
    _require(
        0 < len(packed.materials) <= MAX_MATERIALS and len(packed.notes) <= MAX_NOTES,
        "too many materials or notes",
    )
    textures = [_texture(texture) for texture in packed.textures]
    _require(
        sum(t.image.shape[0] * t.image.shape[1] for t in textures) <= 2 * MAX_KEPT_PIXELS, "textures are too large"
    )
    uv = None if packed.uv is None else _floats("uv", packed.uv, 4, np.inf, count)
    material_of = packed.triangle_materials
    if material_of is not None:
        numbers = _rows("triangle_materials", material_of, np.int32, 1, len(triangles)).reshape(-1)
        _require_numbers("triangle_materials", numbers, len(packed.materials))
    return Mesh(
        vertices=vertices,
        triangles=triangles,
        vertex_colors=_floats("vertex_colors", packed.vertex_colors, 3, np.inf, count),
        normals=_floats("normals", packed.normals, 3, 1.01, count),
        up_axis=packed.up_axis,
        notes=packed.notes,
        uv=uv,
        triangle_materials=None if material_of is None else numbers,
        materials=tuple(_material(material, textures) for material in packed.materials),
    )


def _texture(packed: _Texture) -> Texture:
    width, height = packed.width, packed.height
    _require(0 < width <= MAX_KEPT_SIDE and 0 < height <= MAX_KEPT_SIDE, "a texture is too large")
    image = _rows("texture", packed.image, np.uint8, 3, width * height).reshape(height, width, 3)
    alpha = packed.alpha
    return Texture(
        image=image,
        beyond=(Beyond(packed.beyond[0]), Beyond(packed.beyond[1])),
        alpha=None if alpha is None else _rows("alpha", alpha, np.uint8, 1, width * height).reshape(height, width),
    )


def _material(packed: _Material, textures: list[Texture]) -> Material:
    for number in (packed.color_texture, packed.surface_texture):
        _require(number is None or 0 <= number < len(textures), "a material's texture does not exist")
    values = (packed.roughness, packed.metalness, packed.opacity, packed.cutoff or 0.0)
    _require(bool(np.isfinite(values).all()), "a material is not finite")
    return Material(
        roughness=packed.roughness,
        metalness=packed.metalness,
        color_texture=None if packed.color_texture is None else textures[packed.color_texture],
        surface_texture=None if packed.surface_texture is None else textures[packed.surface_texture],
        cutoff=packed.cutoff,
        opacity=packed.opacity,
    )


def _raw(array: NDArray[Any]) -> memoryview:
    return np.ascontiguousarray(array).data.cast("B") if array.size else memoryview(b"")


def _rows(name: str, data: memoryview, dtype: type, columns: int, count: int | None = None) -> NDArray[Any]:
    """[n, columns] as a copy. Raises MeshError if the number of bytes does not match."""
    size = np.dtype(dtype).itemsize * columns
    _require(data.nbytes % size == 0 and count in (None, data.nbytes // size), f"{name} has {data.nbytes} bytes")
    return np.frombuffer(data, dtype).reshape(-1, columns).copy()


def _floats(name: str, data: memoryview, columns: int, most: float, count: int | None = None) -> NDArray[np.float32]:
    values: NDArray[np.float32] = _rows(name, data, np.float32, columns, count)
    _require(bool(np.isfinite(values).all() and np.abs(values).max(initial=0) <= most), f"{name} are out of bounds")
    return values


def _require_numbers(name: str, numbers: NDArray[np.int32], count: int) -> None:
    _require(bool(numbers.min() >= 0 and numbers.max() < count), f"{name} refer to elements that do not exist")


def _require(holds: bool, wrong: str) -> None:
    if not holds:
        raise MeshError(wrong)
