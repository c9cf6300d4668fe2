"""Triangle meshes of the solids. Flat faces are exact, round surfaces within `TOLERANCE_M`."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from client.synthetic.solids.carved import Carved
from client.synthetic.solids.charts import frame_around
from client.synthetic.solids.polyhedra import Polyhedron, Solid
from client.synthetic.solids.round import Cylinder, Sphere

TOLERANCE_M = 2e-5
"""Largest distance between a triangle and the round surface."""

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Triangles:
    """A mesh or a piece of one; vertices are not shared between pieces, so edges stay sharp."""

    vertices: Floats
    """[v, 3] world metres."""
    normals: Floats
    """[v, 3] unit, outward, of the true surface."""
    faces: NDArray[np.int64]
    """[t, 3] counter-clockwise seen from outside."""


def triangles_of(solids: list[Solid]) -> Triangles:
    """Surfaces of all solids, including parts inside other solids. Raises TypeError for an unsupported solid."""
    return joined([piece for solid in solids for piece in _pieces(solid)])


def can_tessellate(solids: list[Solid]) -> bool:
    """Whether `triangles_of` supports all of them."""
    return all(isinstance(solid, Polyhedron | Sphere | Cylinder | Carved) for solid in solids)


def joined(pieces: list[Triangles]) -> Triangles:
    """Concatenate meshes."""
    first = np.cumsum([0, *(len(piece.vertices) for piece in pieces)])
    return Triangles(
        np.concatenate([piece.vertices for piece in pieces]),
        np.concatenate([piece.normals for piece in pieces]),
        np.concatenate([piece.faces + start for piece, start in zip(pieces, first, strict=False)]),
    )


def _pieces(solid: Solid) -> list[Triangles]:
    match solid:
        case Polyhedron():
            return [_face(_outline(solid, k), n) for k, n in enumerate(solid.plane_normals)]
        case Sphere():
            return [_ball(solid)]
        case Cylinder():
            low, high = (_rim(solid, end, _angles(solid.radius)) for end in (0.0, solid.length))
            return [_side(solid, low, high), _face(low, -solid.axis), _face(high, solid.axis)]
        case Carved(outer=Cylinder() as outer, hole=hole):
            return _bowl(outer, hole)
        case Carved(outer=Polyhedron() as outer, hole=hole):
            return _arch(outer, hole)
        case _:
            raise TypeError(f"no triangles of {type(solid).__name__}")


def _outline(solid: Polyhedron, plane: int) -> Floats:
    """[n, 3] corners of a face, counter-clockwise seen from outside."""
    normal = solid.plane_normals[plane]
    face = solid.corners[np.abs(solid.corners @ normal - solid.plane_offsets[plane]) < 1e-9]
    u, v = frame_around(normal)
    offset = face - face.mean(axis=0)
    outline: Floats = face[np.argsort(np.arctan2(offset @ v, offset @ u))]
    return outline


def _face(outline: Floats, normal: Floats) -> Triangles:
    """A flat convex face; corners in either order of rotation."""
    fan = np.array([(0, k, k + 1) for k in range(1, len(outline) - 1)])
    return _oriented(Triangles(outline, np.broadcast_to(normal, outline.shape), fan))


def _angles(radius: float) -> Floats:
    """Angles of a full circle whose chords stay within the tolerance."""
    step = 2 * math.acos(max(1 - TOLERANCE_M / radius, 0.0))
    angles: Floats = np.linspace(0, 2 * np.pi, max(math.ceil(2 * np.pi / step), 12) + 1)
    return angles


def _rim(solid: Cylinder, height: float, angles: Floats) -> Floats:
    """[n, 3] points of the circle at `height`; 2 pi gives exactly the point of 0."""
    u, v = frame_around(solid.axis)
    angles = angles % (2 * np.pi)
    around = np.cos(angles)[:, None] * u + np.sin(angles)[:, None] * v
    return solid.base + height * solid.axis + solid.radius * around


def _side(solid: Cylinder, low: Floats, high: Floats, outward: float = 1.0) -> Triangles:
    """The strip between two rims with the same angles."""
    center = solid.base + ((low - solid.base) @ solid.axis)[:, None] * solid.axis
    return _strip(low, high, outward * (low - center) / solid.radius)


def _strip(low: Floats, high: Floats, normals: Floats) -> Triangles:
    """Quadrilaterals between two lines of points that share normals [n, 3]."""
    k, n = np.arange(len(low) - 1), len(low)
    faces = np.concatenate([np.stack([k, k + 1, n + k], 1), np.stack([k + 1, n + k + 1, n + k], 1)])
    return _oriented(Triangles(np.concatenate([low, high]), np.concatenate([normals, normals]), faces))


def _ball(solid: Sphere) -> Triangles:
    """Rings between two poles, with shared vertices, so that the mesh is closed."""
    azimuth = _angles(solid.radius)[:-1]
    columns, rings = len(azimuth), len(azimuth) // 2
    polar = (np.pi * np.arange(1, rings) / rings)[:, None]
    level = np.sin(polar)
    around = np.stack([level * np.sin(azimuth), np.cos(polar) + 0 * azimuth, level * np.cos(azimuth)], axis=-1)
    normals = np.concatenate([around.reshape(-1, 3), [[0, 1, 0], [0, -1, 0]]])
    here = np.arange(around[..., 0].size).reshape(rings - 1, columns)
    right = np.roll(here, -1, axis=1)
    top, bottom = np.full(columns, here.size), np.full(columns, here.size + 1)
    corners = [
        (here[:-1], here[1:], right[:-1]),
        (right[:-1], here[1:], right[1:]),
        (top, here[0], right[0]),
        (bottom, here[-1], right[-1]),
    ]
    faces = np.concatenate([np.stack([k.ravel() for k in triangle], axis=1) for triangle in corners])
    return _oriented(Triangles(solid.center + solid.radius * normals, normals, faces))


def _bowl(outer: Cylinder, hole: Cylinder) -> list[Triangles]:
    """A coaxial hole from above that ends before the bottom."""
    angles, top = _angles(outer.radius), outer.length
    depth = float((hole.base - outer.base) @ outer.axis)
    outside = [_rim(outer, height, angles) for height in (0.0, top)]
    inside = [_rim(hole, height, angles) for height in (0.0, top - depth)]
    up = np.broadcast_to(outer.axis, outside[1].shape)
    return [
        _side(outer, outside[0], outside[1]),
        _face(outside[0], -outer.axis),
        _side(hole, inside[0], inside[1], outward=-1.0),
        _face(inside[0], outer.axis),
        _strip(inside[1], outside[1], up),
    ]


def _arch(outer: Polyhedron, hole: Cylinder) -> list[Triangles]:
    """A box with a half-cylinder hole from end to end, whose axis lies in one face."""
    along = outer.plane_normals @ hole.axis
    gaps = outer.plane_offsets - outer.plane_normals @ hole.base
    (bottom,) = np.flatnonzero((np.abs(along) < 1e-9) & (np.abs(gaps) < 1e-9))
    ends = np.flatnonzero(np.abs(along) > 1 - 1e-9)
    up = -outer.plane_normals[bottom]
    pieces, arcs = [], []
    for number, (normal, offset) in enumerate(zip(outer.plane_normals, outer.plane_offsets, strict=True)):
        if number in ends:
            center = hole.base + (offset - normal @ hole.base) / (normal @ hole.axis) * hole.axis
            arc, outline = _around_hole(outer, hole, center, up, np.delete(np.arange(len(gaps)), [*ends, bottom]))
            pieces.append(_strip(arc, outline, np.broadcast_to(normal, arc.shape)))
            arcs.append((arc, (center - arc) / hole.radius))
        elif number != bottom:
            pieces.append(_face(_outline(outer, number), normal))
    (first, normals), (second, _) = arcs
    return [*pieces, _strip(first, second, normals), *_feet(first, second, outer, int(bottom))]


def _around_hole(
    outer: Polyhedron, hole: Cylinder, center: Floats, up: Floats, walls: NDArray[np.intp]
) -> tuple[Floats, Floats]:
    """[n, 3] points of the half circle, and hits of the rays from `center` through them with the `walls`."""
    right = np.cross(up, hole.axis)
    offset = outer.corners - center
    offset = offset[np.abs(offset @ hole.axis) < 1e-9]
    corners = np.arctan2(offset @ up, offset @ right)
    half = np.linspace(0, np.pi, len(_angles(hole.radius)) // 2 + 1)
    angles = np.unique(np.concatenate([half, corners[(corners > 1e-6) & (corners < np.pi - 1e-6)]]))
    rays = np.cos(angles)[:, None] * right + np.sin(angles)[:, None] * up
    normals = outer.plane_normals[walls]
    slopes = rays @ normals.T
    distances = np.where(
        slopes > 1e-9, (outer.plane_offsets[walls] - normals @ center) / np.maximum(slopes, 1e-9), np.inf
    )
    return center + hole.radius * rays, center + distances.min(axis=1)[:, None] * rays


def _feet(first: Floats, second: Floats, outer: Polyhedron, bottom: int) -> list[Triangles]:
    """The parts of the bottom face on both sides of the hole."""
    face, normal = _outline(outer, bottom), outer.plane_normals[bottom]
    sideways = first[-1] - first[0]
    middle = (first[-1] + first[0]) / 2
    pieces = []
    for near, sign in ((0, -1.0), (-1, 1.0)):
        there = face[sign * ((face - middle) @ sideways) > 0]
        there = there[np.argsort((there - second[near]) @ (first[near] - second[near]))]
        pieces.append(_face(np.array([second[near], first[near], there[1], there[0]]), normal))
    return pieces


def _oriented(mesh: Triangles) -> Triangles:
    """Without degenerate faces, and with corners counter-clockwise seen from the side of the normals."""
    a, b, c = (mesh.vertices[mesh.faces[:, k]] for k in range(3))
    crosses = np.cross(b - a, c - a)
    agrees = (crosses * mesh.normals[mesh.faces].sum(axis=1)).sum(axis=1) >= 0
    faces = np.where(agrees[:, None], mesh.faces, mesh.faces[:, ::-1])
    return Triangles(mesh.vertices, mesh.normals, faces[np.linalg.norm(crosses, axis=1) > 1e-12])
