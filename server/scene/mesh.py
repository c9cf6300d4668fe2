"""A virtual object's mesh: read from a file's bytes, checked, and made ready for the rasteriser."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from server.scene.limits import MAX_COORDINATE_M, MeshError
from server.scene.mesh_parts import FORMATS, MeshPart, read_parts
from server.scene.normals import creased_normals, face_crosses, numbered, unit

UpAxis = Literal["y", "z"]

__all__ = ["Mesh", "MeshError", "UpAxis", "load_mesh"]

_LEAST_AREA = 1e-12
"""A triangle is flat if its area is below this share of its longest edge's square."""


@dataclass(frozen=True)
class Mesh:
    """Triangles with smooth attributes, in model metres. Every number is finite, every triangle has an area."""

    vertices: NDArray[np.float32]
    """[v, 3] model metres."""
    triangles: NDArray[np.int32]
    """[t, 3] indices into the vertices, counter-clockwise seen from outside where the file says so."""
    vertex_colors: NDArray[np.float32]
    """[v, 3] linear base colour, 0 to 1."""
    normals: NDArray[np.float32]
    """[v, 3] unit, model axes."""
    up_axis: UpAxis
    """The model axis that points up: +y for obj, glb and gltf, +z for ply and stl."""
    notes: tuple[str, ...] = ()
    """What was dropped or not read, one line each."""

    @property
    def bounds(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Lowest and highest corner of the box around the vertices, [3] each, model metres."""
        return self.vertices.min(axis=0).astype(np.float64), self.vertices.max(axis=0).astype(np.float64)


def load_mesh(data: bytes, format: str) -> Mesh:
    """The mesh in `data`, a file of format glb, gltf, obj, ply or stl, with its scene graph applied.

    Raises MeshError with one line if there is nothing that can be placed.
    """
    if format not in FORMATS:
        raise MeshError(f"mesh format {format!r} is not supported: use {', '.join(FORMATS[:-1])} or {FORMATS[-1]}")
    parts, notes = read_parts(data, format)
    dropped: Counter[str] = Counter()
    usable = [_with_normals(part) for part in (_without_bad(part, dropped) for part in parts) if len(part.triangles)]
    notes += tuple(f"{count} triangles {reason} were dropped" for reason, count in dropped.items())
    if not usable:
        raise MeshError("; ".join((f"the {format} file has no triangles that can be shown", *notes)))
    return _joined(usable, "y" if format in {"obj", "glb", "gltf"} else "z", notes)


def _without_bad(part: MeshPart, dropped: Counter[str]) -> MeshPart:
    """The part less the triangles that cannot be drawn, and less the vertices that nothing uses; counts them."""
    exists = _all_corners((part.triangles >= 0) & (part.triangles < len(part.vertices)))
    triangles = _kept(part.triangles, exists, "with vertices that do not exist", dropped)
    with np.errstate(over="ignore", invalid="ignore"):
        finite = _all_corners(np.abs(part.vertices) <= MAX_COORDINATE_M)  # NaN compares false
        vertices = part.vertices.astype(np.float32)
    triangles = _kept(triangles, _all_corners(finite[triangles]), "with vertices that are not finite", dropped)
    triangles = _kept(triangles, _has_area(vertices, triangles), "without area", dropped)
    used, inverse = np.unique(triangles, return_inverse=True)
    normals = None if part.normals is None else part.normals[used]
    return MeshPart(vertices[used].astype(np.float64), inverse.reshape(-1, 3), part.colors[used], normals)


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
    """The part with unit normals: its own where the file has all of them, else computed, sharp at creases."""
    if part.normals is not None:
        lengths = np.linalg.norm(part.normals, axis=1)
        if (np.isfinite(lengths) & (lengths > 1e-6)).all():
            return replace(part, normals=unit(part.normals))
    same = numbered(np.hstack([part.vertices, part.colors]))  # an STL repeats its vertices in every triangle
    _, first = np.unique(same, return_index=True)
    vertices, colors = part.vertices[first], part.colors[first]
    source, triangles, normals = creased_normals(vertices, same[part.triangles])
    return MeshPart(vertices[source], triangles, colors[source], normals)


def _joined(parts: list[MeshPart], up_axis: UpAxis, notes: tuple[str, ...]) -> Mesh:
    first = np.cumsum([0, *(len(part.vertices) for part in parts)])
    normals = [part.normals for part in parts if part.normals is not None]
    return Mesh(
        vertices=np.concatenate([part.vertices for part in parts]).astype(np.float32),
        triangles=np.concatenate([p.triangles + f for p, f in zip(parts, first, strict=False)]).astype(np.int32),
        vertex_colors=np.concatenate([part.colors for part in parts]).astype(np.float32),
        normals=np.concatenate(normals).astype(np.float32),
        up_axis=up_axis,
        notes=notes,
    )
