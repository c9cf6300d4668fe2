"""Rendering of a scene: ray casting and shading of each pixel."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from client.synthetic.lighting.harmonics import unshadowed_transfer
from client.synthetic.lighting.lamps import Lamp, lamplight
from client.synthetic.lighting.lights import DistantLight
from client.synthetic.scenes.textures import PLAIN_ALBEDO, Texture
from client.synthetic.solids.charts import Grid
from client.synthetic.solids.polyhedra import Solid
from protocol.frames import CameraModel

BACKDROP = 0.3
"""Factor of the sky in pixels without surface, so that it stays within the picture's range."""

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class LitSolid:
    """A solid with its texture and shadows."""

    solid: Solid
    texture: Texture | None
    """None: PLAIN_ALBEDO."""
    grids: list[Grid]
    occluded: tuple[tuple[list[Grid], NDArray[np.float32]], ...]
    """(grids of this solid, table [total, 3] of the light that shadows remove)."""
    bounced: tuple[list[Grid], NDArray[np.float32]] | None = None
    """(grids of this solid, table [total, 3] of the light that surfaces send to each other); None: left out."""


@dataclass(frozen=True)
class Rendering:
    """Exact values per pixel; 0 where `owner` is -1."""

    depth_m: Floats
    """[h, w] along the camera's z; 0: no surface."""
    owner: NDArray[np.int16]
    """[h, w] index of the solid, then of the lamps' bulbs; -1: no surface."""
    normals: Floats
    """[h, w, 3] world."""
    albedo: Floats
    """[h, w, 3] linear."""
    radiance: Floats
    """[h, w, 3] linear, in units of the picture; the dimmed sky where there is no surface."""
    lamplight: Floats
    """[h, w, 3] part of the radiance that is reflected light of lamps."""


def camera_rays(camera: CameraModel) -> Floats:
    """[h * w, 3] camera-space directions with z = 1, so that ray parameters are depths."""
    v, u = np.mgrid[0 : camera.height, 0 : camera.width]
    x, y = (u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy
    return np.stack([x, y, np.ones_like(x)], axis=-1).reshape(-1, 3)


def look_at(position: Floats, target: Floats, up: Floats) -> Floats:
    """world_from_camera [4, 4] (x right, y down, z forward) at `position`, looking at `target`."""
    forward = (target - position) / np.linalg.norm(target - position)
    right = np.cross(forward, up)
    right /= np.linalg.norm(right)
    pose = np.eye(4)
    pose[:3, :3] = np.stack([right, np.cross(forward, right), forward], axis=1)
    pose[:3, 3] = position
    return pose


def cast(solids: list[Solid], camera: CameraModel, rays: Floats, pose: Floats) -> tuple[Floats, NDArray[np.int16]]:
    """Depth in metres (inf: none) and index of the solid (-1: none) of each of the h * w rays."""
    directions, origin = rays @ pose[:3, :3].T, pose[:3, 3]
    depth = np.full((camera.height, camera.width), np.inf)
    owner = np.full(depth.shape, -1, np.int16)
    directions = directions.reshape(*depth.shape, 3)
    for number, solid in enumerate(solids):
        window = _window(solid, camera, pose)
        there = directions[window]
        if not there.size:
            continue
        t = solid.intersect(origin, there.reshape(-1, 3)).reshape(there.shape[:2])
        nearer = t < depth[window]
        depth[window][nearer] = t[nearer]
        owner[window][nearer] = number
    return depth.ravel(), owner.ravel()


def render(
    bodies: list[LitSolid],
    camera: CameraModel,
    rays: Floats,
    pose: Floats,
    light: DistantLight,
    lamps: tuple[Lamp, ...] = (),
) -> Rendering:
    """Render one view. `rays`: of `camera_rays`; `pose`: world_from_camera [4, 4]."""
    solids: list[Solid] = [body.solid for body in bodies]
    depth, owner = cast([*solids, *(lamp.bulb for lamp in lamps)], camera, rays, pose)
    directions = rays @ pose[:3, :3].T
    count = len(rays)
    normals, albedo, radiance = np.zeros((count, 3)), np.zeros((count, 3)), np.empty((count, 3))
    near = np.zeros((count, 3))
    for number, body in enumerate(bodies):
        pixels = np.flatnonzero(owner == number)
        if pixels.size:
            points = pose[:3, 3] + depth[pixels, None] * directions[pixels]
            normals[pixels] = body.solid.normals(points)
            albedo[pixels] = PLAIN_ALBEDO if body.texture is None else body.texture(points)
            near[pixels] = albedo[pixels] * lamplight(lamps, solids, points, normals[pixels])
            radiance[pixels] = albedo[pixels] * irradiance(body, points, normals[pixels], light) + near[pixels]
    for number, lamp in enumerate(lamps, len(bodies)):
        pixels = np.flatnonzero(owner == number)
        normals[pixels] = lamp.bulb.normals(pose[:3, 3] + depth[pixels, None] * directions[pixels])
        radiance[pixels] = lamp.radiance
    empty = np.flatnonzero(owner < 0)
    away = directions[empty] / np.linalg.norm(directions[empty], axis=1, keepdims=True)
    radiance[empty] = BACKDROP * light.radiance(away)
    depth[empty] = 0
    shape = (camera.height, camera.width)
    return Rendering(
        depth.reshape(shape),
        owner.reshape(shape),
        normals.reshape(*shape, 3),
        albedo.reshape(*shape, 3),
        radiance.reshape(*shape, 3),
        near.reshape(*shape, 3),
    )


def irradiance(body: LitSolid, points: Floats, normals: Floats, light: DistantLight) -> Floats:
    """[n, 3] irradiance / pi. The unshadowed part is exact, shadows are interpolated."""
    part = body.solid.part(points)
    arriving = np.empty((len(points), 3))
    for number in np.unique(part):
        here = part == number
        flat = body.grids[number].is_flat
        clear = unshadowed_transfer(normals[here][:1] if flat else normals[here]) @ light.sh
        arriving[here] = clear
        for grids, table in body.occluded:
            arriving[here] -= grids[number].interpolate(table, points[here])
        if body.bounced is not None:
            grids, table = body.bounced
            arriving[here] += grids[number].interpolate(table, points[here])
    return np.maximum(arriving, 0)


def _window(solid: Solid, camera: CameraModel, pose: Floats) -> tuple[slice, slice]:
    """Rows and columns that contain the projected bounding sphere; all of them if it is too near."""
    everything = (slice(0, camera.height), slice(0, camera.width))
    if solid.bounds is None:
        return everything
    center, radius = solid.bounds
    x, y, z = pose[:3, :3].T @ (center - pose[:3, 3])
    if z - radius < 0.05:
        return everything if z + radius > 0 else (slice(0, 0), slice(0, 0))
    return (
        _span(y, z, radius, camera.fy, camera.cy, camera.height),
        _span(x, z, radius, camera.fx, camera.cx, camera.width),
    )


def _span(across: float, ahead: float, radius: float, focal: float, center: float, size: int) -> slice:
    """Pixels between the tangents from the camera to a circle."""
    angle = np.arctan2(across, ahead)
    half = np.arcsin(min(radius / np.hypot(across, ahead), 1))
    low, high = np.tan(np.clip([angle - half, angle + half], -1.5, 1.5)) * focal + center
    return slice(int(np.clip(low - 1, 0, size)), int(np.clip(high + 2, 0, size)))
