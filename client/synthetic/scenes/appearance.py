"""Appearances of the stage set: textures in surface coordinates, with linear albedo from 0.03 to 0.8.

Patterns follow two coordinates along the surface, around columns and up roofs. Their lines are some millimetres wide
with soft edges, so that pictures of 320x240 do not alias.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from client.synthetic.scenes.textures import Texture
from client.synthetic.solids.carved import Carved
from client.synthetic.solids.polyhedra import Polyhedron
from client.synthetic.solids.round import Cylinder, Sphere

SOFT_M = 0.0012
"""Half the width of an edge."""

Values = NDArray[np.floating]
Color = tuple[float, float, float]
Convex = Polyhedron | Cylinder | Sphere


@dataclass(frozen=True)
class StageSurface:
    """A surface of the stage set."""

    role: str
    """ground, wall, stone, roof or dome."""
    building: int
    """From 1; 0 is the ground."""
    solid: Convex | Carved
    rotation: NDArray[np.float64]
    """[3, 3] world_from_building."""


Appearance = Callable[[StageSurface], Texture]


def along_surface(surface: StageSurface, points: Values) -> tuple[Values, Values]:
    """[n] metres across and up the surface at points [n, 3]; on horizontal faces along the building's axes."""
    local = points @ surface.rotation
    normals = surface.solid.normals(points) @ surface.rotation
    center = surface.solid.bounds[0] @ surface.rotation
    level = np.hypot(normals[:, 0], normals[:, 2])
    facing = np.arctan2(normals[:, 0], normals[:, 2])
    sideways = local - center
    across = sideways[:, 0] * np.cos(facing) - sideways[:, 2] * np.sin(facing) + _radius(surface.solid) * facing
    is_flat = level < 0.1
    up = local[:, 1] / np.maximum(level, 0.1)
    return np.where(is_flat, local[:, 0], across), np.where(is_flat, local[:, 2], up)


def _radius(solid: Convex | Carved) -> float:
    match solid:
        case Cylinder() | Sphere():
            return solid.radius
        case Carved():
            return _radius(solid.outer)
        case _:
            return 0.0


def paper(_surface: StageSurface) -> Texture:
    """White everywhere."""
    return lambda points: np.full((len(points), 3), 0.78)


def checker(surface: StageSurface) -> Texture:
    """Black and white squares on all surfaces, so that there are edges everywhere."""
    side = 0.04 if surface.role == "ground" else 0.02

    def texture(points: Values) -> Values:
        u, v = along_surface(surface, points)
        sign = _waves(u, side) * _waves(v, side)
        return (0.41 + 0.35 * sign)[:, None] * np.ones(3)

    return texture


def brick(surface: StageSurface) -> Texture:
    """Bricks, ashlar, slate and lead; slabs on the ground."""
    match surface.role:
        case "wall":
            return _courses(surface, (0.036, 0.014), (0.42, 0.13, 0.07), (0.55, 0.5, 0.42), 0.25)
        case "stone":
            return _courses(surface, (0.05, 0.022), (0.58, 0.47, 0.3), (0.34, 0.28, 0.2), 0.12)
        case "roof":
            return _courses(surface, (0.018, 0.012), (0.1, 0.12, 0.16), (0.05, 0.05, 0.06), 0.3)
        case "dome":
            return _courses(surface, (0.026, 0.024), (0.2, 0.36, 0.3), (0.12, 0.22, 0.18), 0.1)
        case _:
            return _courses(surface, (0.06, 0.06), (0.36, 0.34, 0.31), (0.2, 0.19, 0.17), 0.2)


def market(surface: StageSurface) -> Texture:
    """Saturated paint, striped roofs, a colourful carpet on the ground."""
    hue = _HUES[surface.building % len(_HUES)]
    match surface.role:
        case "ground":
            return _patches(surface)
        case "roof":
            return _stripes(surface, hue, (0.75, 0.72, 0.66), 0.012)
        case "stone":
            return _stripes(surface, hue, _HUES[(surface.building + 3) % len(_HUES)], 0.03)
        case _:
            return _plain(hue)


def town(surface: StageSurface) -> Texture:
    """Plaster with windows, tiled roofs, sandstone, a copper dome; cobbles and grass on the ground."""
    match surface.role:
        case "wall":
            return _windows(surface, _PLASTER[surface.building % len(_PLASTER)])
        case "stone":
            return _courses(surface, (0.044, 0.018), (0.62, 0.52, 0.36), (0.5, 0.41, 0.28), 0.08)
        case "roof":
            return _courses(surface, (0.014, 0.01), (0.45, 0.16, 0.08), (0.3, 0.1, 0.06), 0.2)
        case "dome":
            return _courses(surface, (0.026, 0.2), (0.22, 0.5, 0.4), (0.14, 0.34, 0.28), 0.0)
        case _:
            return _square_and_grass(surface)


APPEARANCES: dict[str, Appearance] = {
    "paper": paper,
    "brick": brick,
    "market": market,
    "checker": checker,
    "town": town,
}

_HUES: tuple[Color, ...] = (
    (0.7, 0.05, 0.06),
    (0.05, 0.2, 0.62),
    (0.75, 0.5, 0.04),
    (0.05, 0.42, 0.12),
    (0.5, 0.06, 0.4),
    (0.04, 0.45, 0.5),
    (0.75, 0.25, 0.04),
)
_PLASTER: tuple[Color, ...] = ((0.7, 0.62, 0.46), (0.66, 0.46, 0.34), (0.72, 0.68, 0.6), (0.5, 0.56, 0.6))


def _plain(color: Color) -> Texture:
    return lambda points: np.ones((len(points), 1)) * np.array(color)


def _courses(surface: StageSurface, size_m: tuple[float, float], face: Color, joint: Color, spread: float) -> Texture:
    """Rows of bricks of `size_m` (length, height), offset by half a brick; shades vary by up to `spread`."""

    def texture(points: Values) -> Values:
        u, v = along_surface(surface, points)
        row = np.floor(v / size_m[1])
        u = u + row % 2 * size_m[0] / 2
        column = np.floor(u / size_m[0])
        edge_m = np.minimum(_to_edge(u, size_m[0]), _to_edge(v, size_m[1]))
        shade = 1 + spread * (2 * _random(row, column, surface.building) - 1)
        return _mix(joint, shade[:, None] * np.array(face), _step(edge_m - 0.0016))

    return texture


def _stripes(surface: StageSurface, one: Color, other: Color, width_m: float) -> Texture:
    def texture(points: Values) -> Values:
        u, _ = along_surface(surface, points)
        return _mix(one, other, 0.5 + 0.5 * _waves(u, width_m))

    return texture


def _patches(surface: StageSurface) -> Texture:
    """Squares of 5 cm, each with one hue."""

    def texture(points: Values) -> Values:
        u, v = along_surface(surface, points)
        row, column = np.floor(v / 0.05), np.floor(u / 0.05)
        colors = np.array(_HUES)[(_random(row, column, 7) * len(_HUES)).astype(int)]
        return _mix((0.72, 0.66, 0.55), colors, _step(np.minimum(_to_edge(u, 0.05), _to_edge(v, 0.05)) - 0.003))

    return texture


def _windows(surface: StageSurface, plaster: Color) -> Texture:
    """Rows of dark windows, 10 mm wide and 14 mm high."""

    def texture(points: Values) -> Values:
        u, v = along_surface(surface, points)
        inside_m = np.minimum(_to_edge(u, 0.022) - 0.006, _to_edge(v, 0.026) - 0.006)
        is_wall = np.abs(surface.solid.normals(points)[:, 1]) < 0.5
        return _mix(plaster, (0.05, 0.07, 0.1), _step(inside_m) * is_wall)

    return texture


def _square_and_grass(surface: StageSurface) -> Texture:
    """Cobbles, lighter on an oval square in the middle, and grass outside."""
    cobbles = _courses(surface, (0.02, 0.016), (0.42, 0.4, 0.37), (0.3, 0.28, 0.26), 0.15)

    def texture(points: Values) -> Values:
        x, _, z = points.T
        away = np.hypot(x / 1.3, z) + 0.008 * np.sin(5 * np.arctan2(x, z))
        grass = np.array([0.14, 0.26, 0.06]) * (1 + 0.15 * np.sin(70 * x) * np.sin(80 * z + 2))[:, None]
        square = cobbles(points) * (1 + 0.4 * _step(0.12 - away))[:, None]
        mixed: Values = square + (grass - square) * _step(away - 0.24)[:, None]
        return mixed

    return texture


def _mix(one: Color | Values, other: Color | Values, share: Values) -> Values:
    mixed: Values = np.asarray(one) + (np.asarray(other) - np.asarray(one)) * share[:, None]
    return mixed


def _step(distance_m: Values) -> Values:
    """Smooth step from 0 to 1 at `distance_m` 0."""
    share: Values = 0.5 + 0.5 * np.tanh(distance_m / SOFT_M)
    return share


def _to_edge(position_m: Values, period_m: float) -> Values:
    """Distance of a position to the edge of its cell."""
    within = position_m % period_m
    distance: Values = np.minimum(within, period_m - within)
    return distance


def _waves(position_m: Values, width_m: float) -> Values:
    """Alternating -1 and 1, each `width_m` wide, with soft edges."""
    wave: Values = np.tanh(np.sin(np.pi * position_m / width_m) * width_m / (np.pi * SOFT_M))
    return wave


def _random(row: Values, column: Values, seed: int) -> Values:
    """[n] pseudo-random in [0, 1) per cell; an integer hash, equal on all machines."""
    mixed = row.astype(np.int64) * 73_856_093 ^ column.astype(np.int64) * 19_349_663 ^ seed * 83_492_791
    mixed &= 0xFFFF_FFFF
    mixed = (mixed ^ mixed >> 13) * 1_274_126_177 & 0xFFFF_FFFF
    numbers: Values = ((mixed ^ mixed >> 16) & 0xFFFF) / 65536
    return numbers
