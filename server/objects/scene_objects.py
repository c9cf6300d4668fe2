"""The virtual objects of a scene: uploaded once and moved by their transforms."""

from __future__ import annotations

import hashlib
from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pyopencl as cl
from numpy.typing import NDArray

from server.objects.rasterize import Placed
from server.objects.virtual_object import VirtualObject
from server.opencl.engine import Engine
from server.scene.limits import MAX_OBJECTS, MAX_SCENE_TEXTURE_PIXELS, MAX_SCENE_TRIANGLES, MeshError
from server.scene.mesh import Mesh
from server.scene.placement import Placement, world_from_model

CELLS, FEWER_CELLS = 64, 24
"""Cells along the longest side of an object's distance grid: the coarser number after FINE_GRIDS different meshes."""
FINE_GRIDS = 64


@dataclass(frozen=True)
class SceneObject:
    """A placed object."""

    mesh: Mesh
    digest: bytes
    world_from_model: NDArray[np.float64]
    """[4, 4]."""
    placement: Placement | None = None
    """The request that `world_from_model` follows from; None: it was given as a matrix."""


class SceneObjects:
    """Objects by id, in order of arrival. Equal meshes are stored on the device once."""

    def __init__(self, engine: Engine, up: NDArray[np.float64]) -> None:
        self._engine = engine
        self.up = up
        self._entries: dict[str, SceneObject] = {}
        self._things: dict[bytes, VirtualObject] = {}
        self._uses: Counter[bytes] = Counter()

    def place(self, object_id: str, mesh: Mesh, placement: Placement) -> None:
        """Add a mesh; it replaces one with the same id.

        Raises ValueError, one line, for an impossible placement or a full scene; the scene is then unchanged.
        """
        self.put(object_id, mesh, world_from_model(mesh, placement, self.up), placement)

    def put(self, object_id: str, mesh: Mesh, matrix: NDArray[np.float64], placement: Placement | None = None) -> None:
        """As place(), with world_from_model `matrix` [4, 4]. Raises MeshError if the scene is full."""
        others = (entry.mesh for name, entry in self._entries.items() if name != object_id)
        check_room(others, mesh)
        digest = mesh_digest(mesh)
        if digest not in self._things:
            cells = CELLS if len(self._things) < FINE_GRIDS else FEWER_CELLS
            try:
                self._things[digest] = VirtualObject.upload(self._engine, mesh, cells)
            except cl.MemoryError as error:
                raise MeshError("the device has no memory left for this object: remove others") from error
        self._uses[digest] += 1
        if object_id in self._entries:
            self.remove(object_id)
        self._entries[object_id] = SceneObject(mesh, digest, matrix, placement)

    def move(self, object_id: str, placement: Placement) -> None:
        """Move an object. Raises KeyError for an unknown id, ValueError as place() does."""
        self.move_to(object_id, world_from_model(self._entries[object_id].mesh, placement, self.up), placement)

    def move_to(self, object_id: str, matrix: NDArray[np.float64], placement: Placement | None = None) -> None:
        """As move(), with world_from_model `matrix` [4, 4]."""
        self._entries[object_id] = replace(self._entries[object_id], world_from_model=matrix, placement=placement)

    def set_up(self, up: NDArray[np.float64]) -> None:
        """Set another up direction [3], unit: objects turn about the points they were placed at."""
        self.up = up
        for object_id, entry in self._entries.items():
            if entry.placement is not None:
                self.move(object_id, entry.placement)

    def remove(self, object_id: str) -> None:
        """Remove an object. Raises KeyError for an unknown id."""
        digest = self._entries.pop(object_id).digest
        self._uses[digest] -= 1
        if self._uses[digest] == 0:
            del self._uses[digest]
            self._things.pop(digest).release()

    def entries(self) -> dict[str, SceneObject]:
        """All objects, in order of arrival."""
        return dict(self._entries)

    def clear(self) -> None:
        """Remove all objects."""
        for object_id in list(self._entries):
            self.remove(object_id)

    def placed(self, volume_from_world: NDArray[np.float64]) -> list[Placed]:
        """Each object with its volume_from_model."""
        entries = self._entries.values()
        return [(self._things[entry.digest], volume_from_world @ entry.world_from_model) for entry in entries]


def check_room(others: Iterable[Mesh], mesh: Mesh) -> None:
    """Raises MeshError, one line, if `mesh` and `others`, the scene's other meshes, exceed the limits together."""
    meshes = tuple(others)
    counts = [len(other.triangles) for other in meshes]
    if len(counts) >= MAX_OBJECTS:
        raise MeshError(f"the scene has {len(counts)} objects, more are not shown: remove some")
    pixels = sum(texture_pixels(other) for other in (*meshes, mesh))
    if pixels > MAX_SCENE_TEXTURE_PIXELS:
        raise MeshError(
            f"with this object the scene would have {pixels >> 20} MiPixel of textures, "
            f"more than {MAX_SCENE_TEXTURE_PIXELS >> 20}: remove objects or give them smaller pictures"
        )
    if sum(counts) + len(mesh.triangles) > MAX_SCENE_TRIANGLES:
        raise MeshError(
            f"with this object the scene would have {sum(counts) + len(mesh.triangles)} triangles, "
            f"more than {MAX_SCENE_TRIANGLES}: remove objects or simplify them"
        )


def texture_pixels(mesh: Mesh) -> int:
    """Of all pictures of a mesh, each once."""
    textures = {t for m in mesh.materials for t in (m.color_texture, m.surface_texture) if t is not None}
    return sum(t.image.shape[0] * t.image.shape[1] for t in textures)


def mesh_digest(mesh: Mesh) -> bytes:
    """The same for meshes that look the same."""
    digest = hashlib.blake2b(digest_size=16)
    arrays: list[NDArray[Any]] = [
        mesh.vertices,
        mesh.triangles,
        mesh.vertex_colors,
        mesh.normals,
        mesh.texture_uv,
        mesh.material_of,
    ]
    for material in mesh.materials:
        digest.update(f"{material.roughness} {material.metalness} ".encode())
        for texture in (material.color_texture, material.surface_texture):
            digest.update(b"none" if texture is None else f"{texture.image.shape} {texture.beyond}".encode())
            if texture is not None:
                arrays.append(texture.image)
    for array in arrays:
        digest.update(f"{array.shape}".encode())
        digest.update(np.ascontiguousarray(array).data)
    return digest.digest()
