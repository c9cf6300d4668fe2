"""Finds the spot on which an object is to be placed in one frame: a pixel's surface, a ray's, a floor, a table.

On horizontal surface an object gets a place where its whole floor fits, nothing stands, and all of it is in the
picture and not hidden, clear of other objects, as near to the middle of the picture as there is one. Where there is
none that large, it gets the freest place. `auto` takes the largest table, else the floor, at the model's own size if
that fits, else at the largest that does.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from protocol.messages import Spot
from server.maths.horizontal_surfaces import HorizontalSurface, find_horizontal_surfaces, floor_of, tables_of
from server.room.frame_view import FrameView
from server.scene.mesh import Mesh
from server.scene.placement import SpotPlacement, model_size
from server.scene.units import guessed_unit

Floats = NDArray[np.float64]

EDGE_SHARE = 0.04
"""Of the picture's width and height: what is in the picture keeps so far from its edges."""
ROOMY = 1.3
"""Free radius that is sought around an object, in those of its floor: it does not stand at the very edge of a table.
 `auto` has no less, other spots have the floor's own if there is no more."""
HIDDEN_M = 0.1
"""What is nearer than a point of the object by more hides it: more than a depth camera's noise, and than the table's
own edge differs from a cell."""
BESIDE_M = 1.0
"""Objects whose heights differ by more do not get into each other's way."""
SHRINK = 0.85
"""Step of the sizes that are tried."""
SMALLEST_M = 0.03
"""Least size of an `auto` object: one that must be smaller to fit is not placed."""


class SpotUnseen(Exception):
    """The frame does not show the spot, a later one may; one line says what is missing."""


@dataclass(frozen=True)
class FoundSpot:
    """A place for an object, in the room's world."""

    position: Floats
    """[3] metres."""
    scale: float
    words: str
    """What it stands on, and its size if that was chosen."""


@dataclass(frozen=True)
class SpotView:
    """A frame in which spots are sought."""

    frame: FrameView
    meet: Callable[[Floats, Floats], Floats | None]
    """Where a ray (origin [3], direction [3], in the room) meets the scan."""
    room_from_client: Floats
    """[4, 4] rigid."""

    @cached_property
    def surfaces(self) -> tuple[list[HorizontalSurface], HorizontalSurface | None]:
        """Tables, the largest in the picture first, and the floor if it is in view."""
        points, normals = self.frame.surface_points()
        up = self.frame.up
        found = find_horizontal_surfaces(points, normals, up)
        floor = floor_of(found, points @ up, float(self.frame.room_from_camera[:3, 3] @ up)) if found else None
        return tables_of(found, floor), floor


def find_spot(view: SpotView, mesh: Mesh, placement: SpotPlacement, taken: Floats) -> FoundSpot:
    """The place of an object in this frame. Raises SpotUnseen; ValueError, one line, if no frame can show it.

    taken: [k, 4] room metres: of the objects that are there, the middle of the floor and its radius.
    """
    spot = placement.spot
    if spot.on == "pixel":
        return FoundSpot(_in_pixel(view, spot), placement.scale or 1.0, _on_pixel(spot))
    if spot.on == "ray":
        return FoundSpot(_on_ray(view, spot), placement.scale or 1.0, "on the surface that its ray meets")
    found, ground = view.surfaces
    tables = [_clear_of(taken, table, view.frame.up) for table in found]
    floor = None if ground is None else _clear_of(taken, ground, view.frame.up)
    if spot.on == "auto":
        return _auto(view.frame, mesh, placement, tables, floor)
    if spot.on == "floor":
        if floor is None:
            raise SpotUnseen("no floor is in view yet")
        return _on_surface(view.frame, mesh, placement.scale or 1.0, floor, "the floor")
    if not tables:
        raise SpotUnseen("no table is in view yet, nor other horizontal surface off the floor")
    return _on_surface(view.frame, mesh, placement.scale or 1.0, tables[0], _table_words(tables[0], floor))


def _in_pixel(view: SpotView, spot: Spot) -> Floats:
    assert spot.pixel is not None
    if spot.frame is not None and view.frame.index < spot.frame:
        raise SpotUnseen(f"frame {spot.frame} has not come yet")
    if spot.frame is not None and view.frame.index > spot.frame:
        raise ValueError(f"frame {spot.frame} was not processed before frame {view.frame.index}: name a later one")
    point = view.frame.in_pixel(*spot.pixel)
    if point is None:
        u, v = spot.pixel
        raise ValueError(f"pixel {u:g},{v:g} of frame {view.frame.index} shows no surface: choose another")
    return point


def _on_pixel(spot: Spot) -> str:
    assert spot.pixel is not None
    return f"on the surface in pixel {spot.pixel[0]:g},{spot.pixel[1]:g}"


def _on_ray(view: SpotView, spot: Spot) -> Floats:
    to_room = view.room_from_client
    origin, direction = np.array(spot.origin_m, np.float64), np.array(spot.direction, np.float64)
    point = view.meet(to_room[:3, :3] @ origin + to_room[:3, 3], to_room[:3, :3] @ direction)
    if point is None:
        raise ValueError("its ray meets no scanned surface: choose another, or scan there first")
    return point


def _clear_of(taken: Floats, surface: HorizontalSurface, up: Floats) -> HorizontalSurface:
    """The surface with less room around what stands at its height."""
    radii = surface.radii_m
    for x, y, z, radius_m in taken:
        offset = surface.centers - (x, y, z)
        heights = offset @ up
        away = np.linalg.norm(offset - heights[:, None] * up, axis=1)
        radii = np.where(np.abs(heights) < BESIDE_M, np.minimum(radii, away - radius_m), radii)
    return replace(surface, radii_m=radii)


def _table_words(table: HorizontalSurface, floor: HorizontalSurface | None) -> str:
    if floor is None:
        return f"a table of {table.area_m2:.1f} m2"
    return f"a table of {table.area_m2:.1f} m2, {table.height_m - floor.height_m:.2f} m over the floor"


def _on_surface(frame: FrameView, mesh: Mesh, scale: float, surface: HorizontalSurface, words: str) -> FoundSpot:
    """At a given size: a place where it fits, else the freest one."""
    diagonal, height = (scale * size for size in model_size(mesh))
    places = (_best_place(frame, surface, room * diagonal / 2, height) for room in (ROOMY, 1.0))
    index = next((place for place in places if place is not None), None)
    if index is None:
        fits = surface.radii_m >= diagonal / 2
        index = int(np.argmax(np.where(fits, np.inf, surface.radii_m)))
        words += (
            "; not all of it is in view"
            if fits.any()
            else f"; its floor of {diagonal:.2f} m does not fit on what is free of it, "
            f"{max(2 * surface.radii_m.max(), 0.0):.2f} m: give a smaller size"
        )
    return FoundSpot(surface.centers[index], scale, f"on {words}")


def _auto(
    frame: FrameView,
    mesh: Mesh,
    placement: SpotPlacement,
    tables: list[HorizontalSurface],
    floor: HorizontalSurface | None,
) -> FoundSpot:
    """On the largest table or the floor; the size is the given one, else the own one, else one that fits."""
    named = [(table, _table_words(table, floor)) for table in tables] + ([(floor, "the floor")] if floor else [])
    if not named:
        raise SpotUnseen("no horizontal surface is in view yet")
    if placement.scale is not None:
        places = [(surface, words) for surface, words in named if _fits(frame, mesh, placement.scale, surface)]
        surface, words = (places or named)[0]
        return _on_surface(frame, mesh, placement.scale, surface, words)
    unit, own = guessed_unit(mesh)
    size_m = own * max(float(side) for side in np.subtract(*mesh.bounds[::-1]))
    said = "" if unit == "m" else f"; its numbers are taken as {unit}"
    for surface, words in named:
        if _fits(frame, mesh, own, surface):
            found = _on_surface(frame, mesh, own, surface, words)
            return _with_size(found, mesh, f"its own size{said}")
    for surface, words in named:
        scale = own * SHRINK
        while scale * size_m / own >= SMALLEST_M:
            if _fits(frame, mesh, scale, surface):
                found = _on_surface(frame, mesh, scale, surface, words)
                return _with_size(found, mesh, f"at its own {size_m:.2f} m it does not fit there{said}")
            scale *= SHRINK
    raise SpotUnseen("no horizontal surface in view has room for it yet")


def _with_size(found: FoundSpot, mesh: Mesh, why: str) -> FoundSpot:
    height_m = found.scale * model_size(mesh)[1]
    words = f"{found.words}, {height_m:.2f} m high (scale {found.scale:.3g}: {why})"
    return FoundSpot(found.position, found.scale, words)


def _fits(frame: FrameView, mesh: Mesh, scale: float, surface: HorizontalSurface) -> bool:
    diagonal, height = (scale * size for size in model_size(mesh))
    return _best_place(frame, surface, ROOMY * diagonal / 2, height) is not None


def _best_place(frame: FrameView, surface: HorizontalSurface, radius_m: float, height_m: float) -> int | None:
    """Index of the free cell with a disc of `radius_m` nearest to the picture's middle, where all of the object is in
    the picture; None if there is none."""
    wide = np.flatnonzero(surface.radii_m >= radius_m)
    if not len(wide):
        return None
    centers = surface.centers[wide]
    size = np.array([frame.camera.width, frame.camera.height])
    hull = frame.project(centers[:, None] + _hull(frame.up, radius_m, height_m))
    edge = EDGE_SHARE * size
    is_in = ((hull[..., :2] >= edge) & (hull[..., :2] <= size - 1 - edge)).all(axis=(1, 2))  # NaN compares false
    inside = np.flatnonzero(is_in)
    is_in = np.zeros(len(wide), np.bool_)
    is_in[inside] = ~_is_hidden(frame, hull[inside])
    if not is_in.any():
        return None
    middle = frame.project(centers + 0.5 * height_m * frame.up)[:, :2]
    away = np.linalg.norm(middle - (size - 1) / 2, axis=1)
    return int(wide[np.argmin(np.where(is_in, away, np.inf))])


def _is_hidden(frame: FrameView, hull: Floats) -> NDArray[np.bool_]:
    """[n] whether something real is before one of the points of a hull, [n, k, 3] as in `FrameView.project`."""
    u, v = hull[..., :2].round().astype(np.int64).transpose(2, 0, 1)
    depth_m = frame.depth_m[v, u]
    return np.asarray(((depth_m > 0) & (depth_m < hull[..., 2] - HIDDEN_M)).any(axis=1))


def _hull(up: Floats, radius_m: float, height_m: float) -> Floats:
    """[12, 3] offsets of points around a standing cylinder from the middle of its floor."""
    across = np.eye(3)[int(np.argmin(np.abs(up)))]
    first = np.cross(up, across)
    first /= np.linalg.norm(first)
    second = np.cross(up, first)
    ring = radius_m * np.array([first, second, -first, -second])
    return np.concatenate([ring, ring + 0.5 * height_m * up, ring + height_m * up])
