"""Scenes whose depth and normals are known in closed form, float64: the truth that geometry is measured against."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from protocol.frames import CameraModel

Floats = NDArray[np.float64]
Shape = Callable[[Floats, Floats], tuple[Floats, Floats]]
"""(origin [3], directions [..., 3]) -> distances along them [...] (infinite where missed), normals [..., 3]."""


@dataclass(frozen=True)
class Truth:
    """What a camera sees of a scene."""

    depth_m: Floats
    """[h, w] along the optical axis, 0 = nothing."""
    points: Floats
    """[h, w, 3] world metres."""
    normals: Floats
    """[h, w, 3] unit, world, towards the camera."""

    @property
    def is_continuous(self) -> NDArray[np.bool_]:
        """[h, w] whether the same smooth surface fills the 5 x 5 pixels around a pixel."""
        height, width = self.depth_m.shape
        reference = self.normals * (self.depth_m > 0)[..., None]
        result = np.zeros((height, width), bool)
        result[2:-2, 2:-2] = True
        for dy in range(-2, 3):
            for dx in range(-2, 3):
                other = np.roll(reference, (dy, dx), (0, 1))
                offset = np.roll(self.points, (dy, dx), (0, 1)) - self.points
                apart = np.abs((offset * reference).sum(-1)) > 0.25 * np.linalg.norm(offset, axis=-1) + 1e-9
                result &= ((other * reference).sum(-1) > 0.8) & ~apart
        return result


def pixel_rays(camera: CameraModel) -> Floats:
    """[h, w, 3] directions in camera space with z = 1."""
    v, u = np.mgrid[: camera.height, : camera.width]
    return np.stack([(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, np.ones_like(u, float)], axis=-1)


def look(scene: Sequence[Shape], camera: CameraModel, world_from_camera: Floats) -> Truth:
    """The nearest of the scene's shapes along every pixel's ray."""
    rays = pixel_rays(camera) @ world_from_camera[:3, :3].T
    depth = np.full(rays.shape[:2], np.inf)
    normals = np.zeros_like(rays)
    for shape in scene:
        distance, normal = shape(world_from_camera[:3, 3], rays)
        nearer = distance < depth
        depth[nearer], normals[nearer] = distance[nearer], normal[nearer]
    depth[~np.isfinite(depth)] = 0
    normals = np.where((normals * rays).sum(-1, keepdims=True) > 0, -normals, normals)
    return Truth(depth, world_from_camera[:3, 3] + depth[..., None] * rays, normals)


def sphere(center: ArrayLike, radius: float) -> Shape:
    """A ball seen from outside."""

    def meet(origin: Floats, rays: Floats) -> tuple[Floats, Floats]:
        offset = origin - np.asarray(center, np.float64)
        a, b, c = (rays * rays).sum(-1), rays @ offset, offset @ offset - radius * radius
        root = b * b - a * c
        distance = np.where(root > 0, (-b - np.sqrt(np.maximum(root, 0))) / a, np.inf)
        distance[distance <= 0] = np.inf
        reached = np.where(np.isfinite(distance), distance, 0)
        return distance, (offset + reached[..., None] * rays) / radius

    return meet


def room(low: ArrayLike, high: ArrayLike) -> Shape:
    """A box seen from inside."""

    def meet(origin: Floats, rays: Floats) -> tuple[Floats, Floats]:
        wall = np.where(rays > 0, high, low)
        with np.errstate(divide="ignore", invalid="ignore"):
            distances = np.where(rays != 0, (wall - origin) / rays, np.inf)
        axis = distances.argmin(-1)
        normals = -np.sign(rays) * (np.arange(3) == axis[..., None])
        return distances.min(-1), normals

    return meet


def box(low: ArrayLike, high: ArrayLike) -> Shape:
    """A box seen from outside."""
    corners = np.array([low, high], np.float64)

    def hit(origin: Floats, directions: Floats) -> tuple[Floats, Floats]:
        with np.errstate(divide="ignore", invalid="ignore"):
            slabs = np.sort((corners[:, None] - origin[None]) / directions.reshape(-1, 3)[None], axis=0)
        slabs = np.where(np.isnan(slabs), np.array([-np.inf, np.inf])[:, None, None], slabs)
        axis = slabs[0].argmax(axis=1)
        enter, leave = slabs[0].max(axis=1), slabs[1].min(axis=1)
        distances = np.where((enter < leave) & (enter > 0), enter, np.inf)
        normals = -np.sign(np.take_along_axis(directions.reshape(-1, 3), axis[:, None], 1)) * np.eye(3)[axis]
        return distances.reshape(directions.shape[:-1]), normals.reshape(directions.shape)

    return hit


def plane(point: ArrayLike, normal: ArrayLike) -> Shape:
    """An endless plane through `point`."""
    unit = np.asarray(normal, np.float64) / np.linalg.norm(normal)

    def meet(origin: Floats, rays: Floats) -> tuple[Floats, Floats]:
        with np.errstate(divide="ignore"):
            distance = ((point - origin) @ unit) / (rays @ unit)
        distance[distance <= 0] = np.inf
        return distance, np.broadcast_to(unit, rays.shape)

    return meet


def look_at(eye: ArrayLike, target: ArrayLike, up: ArrayLike = (0.0, -1.0, 0.0)) -> Floats:
    """[4, 4] world_from_camera of a camera at `eye` that looks at `target`."""
    forward = np.asarray(target, np.float64) - eye
    forward /= np.linalg.norm(forward)
    right = np.cross(forward, up)
    right /= np.linalg.norm(right)
    pose = np.eye(4)
    pose[:3, :3] = np.stack([right, np.cross(forward, right), forward], axis=1)
    pose[:3, 3] = eye
    return pose


def quantised(depth_m: Floats, step_m: float = 0.001) -> Floats:
    """Depth as a sensor with whole units gives it."""
    return np.rint(depth_m / step_m) * step_m
