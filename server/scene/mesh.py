"""A virtual object's mesh: reads a file, validates it, and prepares it for the rasterizer."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from server.scene.cutout import cut_out
from server.scene.limits import MAX_COORDINATE_M, MeshError
from server.scene.materials import MATTE, Material
from server.scene.mesh_parts import FORMATS, MeshPart, read_parts
from server.scene.normals import creased_normals, face_crosses, numbered, unit

UpAxis = Literal["y", "z"]

__all__ = ["Mesh", "MeshError", "UpAxis", "load_mesh"]

_LEAST_AREA = 1e-12
"""A triangle is degenerate if its area is below this share of its longest edge squared."""


@dataclass(frozen=True)
class Mesh:
    """Triangles with smooth attributes, in model metres. Every number is finite, every triangle has an area."""

    vertices: NDArray[np.float32]
    """[v, 3] model metres."""
    triangles: NDArray[np.int32]
    """[t, 3] vertex indices, counter-clockwise seen from outside if the file's winding is correct."""
    vertex_colors: NDArray[np.float32]
    """[v, 3] linear base colour, 0 to 1; the materials' textures multiply it."""
    normals: NDArray[np.float32]
    """[v, 3] unit, model axes."""
    up_axis: UpAxis
    """The model axis that points up: +y for obj, glb and gltf, +z for ply and stl."""
    notes: tuple[str, ...] = ()
    """What was removed or not read, one line each."""
    uv: NDArray[np.float32] | None = None
    """[v, 4] texture coordinates of base colour, and of roughness and metalness; (0, 0) is the upper left corner."""
    triangle_materials: NDArray[np.int32] | None = None
    """[t] index of the material; None: all use the first."""
    materials: tuple[Material, ...] = (MATTE,)

    @property
    def texture_uv(self) -> NDArray[np.float32]:
        """[v, 4] `uv`; zeros if there are none."""
        return np.zeros((len(self.vertices), 4), np.float32) if self.uv is None else self.uv

    @property
    def material_of(self) -> NDArray[np.int32]:
        """[t] `triangle_materials`; zeros if all use the first."""
        return np.zeros(len(self.triangles), np.int32) if self.triangle_materials is None else self.triangle_materials

    @property
    def bounds(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Lowest and highest corner of the box around the vertices, [3] each, model metres."""
        return self.vertices.min(axis=0).astype(np.float64), self.vertices.max(axis=0).astype(np.float64)


def load_mesh(data: bytes, format: str) -> Mesh:
    """Load a mesh from the bytes of a glb, gltf, obj, ply or stl file and apply its scene graph.

    Raises MeshError, one line, if nothing can be placed.
    """
    if format not in FORMATS:
        raise MeshError(f"mesh format {format!r} is not supported: use {', '.join(FORMATS[:-1])} or {FORMATS[-1]}")
    parts, notes = read_parts(data, format)
    dropped: Counter[str] = Counter()
    usable = [_with_normals(part) for part in (_without_bad(part, dropped) for part in parts) if len(part.triangles)]
    notes += tuple(f"{count} triangles {reason} were dropped" for reason, count in dropped.items())
    if usable:
        usable = cut_out(usable)
        notes += () if usable else ("all of it is less opaque than its materials' cutoff",)
    if not usable:
        raise MeshError("; ".join((f"the {format} file has no triangles that can be shown", *notes)))
    return _joined(usable, "y" if format in {"obj", "glb", "gltf"} else "z", notes)


def _without_bad(part: MeshPart, dropped: Counter[str]) -> MeshPart:
    """Remove and count triangles that cannot be drawn, and remove unused vertices."""
    exists = _all_corners((part.triangles >= 0) & (part.triangles < len(part.vertices)))
    triangles = _kept(part.triangles, exists, "with vertices that do not exist", dropped)
    with np.errstate(over="ignore", invalid="ignore"):
        finite = _all_corners(np.abs(part.vertices) <= MAX_COORDINATE_M)  # NaN compares false
        vertices = part.vertices.astype(np.float32)
    triangles = _kept(triangles, _all_corners(finite[triangles]), "with vertices that are not finite", dropped)
    triangles = _kept(triangles, _has_area(vertices, triangles), "without area", dropped)
    used, inverse = np.unique(triangles, return_inverse=True)
    normals = None if part.normals is None else part.normals[used]
    return replace(
        part,
        vertices=vertices[used].astype(np.float64),
        triangles=inverse.reshape(-1, 3),
        colors=part.colors[used],
        normals=normals,
        uv=part.uv[used],
    )


def _all_corners(good: NDArray[np.bool_]) -> NDArray[np.bool_]:
    every: NDArray[np.bool_] = np.logical_and.reduce(good, axis=1)
    return every


def _kept(
    triangles: NDArray[np.int64], good: NDArray[np.bool_], reason: str, dropped: Counter[str]
) -> NDArray[np.int64]:
    if not good.all():
        dropped[reason] += int((~good).sum())
    return triangles[good]


def _has_area(vertices: NDArray[np.float32], triangles: NDArray[np.int64]) -> NDArray[np.bool_]:
    corners = vertices[triangles].astype(np.float64)
    longest_squared = (np.diff(corners[:, [0, 1, 2, 0]], axis=1) ** 2).sum(axis=2).max(axis=1, initial=0)
    double_area = np.linalg.norm(face_crosses(vertices, triangles), axis=1)
    good: NDArray[np.bool_] = double_area > _LEAST_AREA * longest_squared
    return good


def _with_normals(part: MeshPart) -> MeshPart:
    """The part with unit normals: the file's if complete, else computed and split at creases."""
    if part.normals is not None:
        lengths = np.linalg.norm(part.normals, axis=1)
        if (np.isfinite(lengths) & (lengths > 1e-6)).all():
            return replace(part, normals=unit(part.normals))
    # STL repeats the vertices of every triangle.
    same = numbered(np.hstack([part.vertices, part.colors, part.uv]))
    _, first = np.unique(same, return_index=True)
    source, triangles, normals = creased_normals(part.vertices[first], same[part.triangles])
    kept = first[source]
    return replace(
        part,
        vertices=part.vertices[kept],
        triangles=triangles,
        colors=part.colors[kept],
        normals=normals,
        uv=part.uv[kept],
    )


def _joined(parts: list[MeshPart], up_axis: UpAxis, notes: tuple[str, ...]) -> Mesh:
    first = np.cumsum([0, *(len(part.vertices) for part in parts)])
    normals = [part.normals for part in parts if part.normals is not None]
    numbers = {material: k for k, material in enumerate(dict.fromkeys(part.material for part in parts))}
    return Mesh(
        vertices=np.concatenate([part.vertices for part in parts]).astype(np.float32),
        triangles=np.concatenate([p.triangles + f for p, f in zip(parts, first, strict=False)]).astype(np.int32),
        vertex_colors=np.concatenate([part.colors for part in parts]).astype(np.float32),
        normals=np.concatenate(normals).astype(np.float32),
        up_axis=up_axis,
        notes=notes,
        uv=np.concatenate([part.uv for part in parts]).astype(np.float32),
        triangle_materials=np.repeat(
            np.array([numbers[part.material] for part in parts], np.int32), [len(part.triangles) for part in parts]
        ),
        materials=tuple(numbers),
    )
