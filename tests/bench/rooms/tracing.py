"""Radiance of a room by path tracing (Mitsuba 3 in its LLVM mode), and pictures without grain (Open Image Denoise)."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import mitsuba
import numpy as np
import pyoidn
from numpy.typing import NDArray

from server.maths.sh import sh_basis
from tests.bench.rooms.furniture import Room, Shape

mitsuba.set_variant("llvm_ad_rgb")

Floats = NDArray[np.float64]

BANDS = 4
MOST_BOUNCES = 8
RAYS_AT_ONCE = 1 << 21
"""In one call of the tracer: a gigabyte."""
PLACE_RAYS = 1 << 21
"""From which the light at a place is found: a lamp of a thousandth of the sphere is met by two thousand."""


class TracedRoom:
    """A room ready to be traced. Radiance is linear RGB."""

    def __init__(self, room: Room) -> None:
        shapes = {f"shape{number}": _described(shape) for number, shape in enumerate(room.shapes)}
        self._scene = mitsuba.load_dict({"type": "scene", **shapes})
        self._tracer = mitsuba.load_dict({"type": "path", "max_depth": MOST_BOUNCES})
        self._calls = 0

    def picture(self, world_from_camera: Floats, directions: Callable[[int], Floats], samples: int) -> Floats:
        """[pixels, 3] the mean of `samples` rays of each pixel.

        directions: of so many rays of each pixel [pixels, rays, 3], unit, camera axes, new ones each time.
        """
        pixels = directions(1).shape[0]
        most, total = max(RAYS_AT_ONCE // pixels, 1), np.zeros((pixels, 3))
        for first in range(0, samples, most):
            count = min(most, samples - first)
            along = (directions(count) @ world_from_camera[:3, :3].T).reshape(-1, 3)
            arriving = self._arriving(np.broadcast_to(world_from_camera[:3, 3], along.shape), along)
            total += arriving.reshape(pixels, count, 3).sum(axis=1)
        return total / samples

    def first_met(self, world_from_camera: Floats, directions: Floats) -> tuple[Floats, Floats, Floats]:
        """Distance [n] in metres, albedo and normal [n, 3] of what rays along the camera's `directions` [n, 3] meet."""
        along = directions @ world_from_camera[:3, :3].T
        origins = np.broadcast_to(world_from_camera[:3, 3], along.shape)
        ray = mitsuba.Ray3f(_vectors(mitsuba.Point3f, origins), _vectors(mitsuba.Vector3f, along))
        met = self._scene.ray_intersect(ray)
        albedo = np.nan_to_num(_array(met.bsdf().eval_diffuse_reflectance(met)))
        return np.array(met.t), albedo, _array(met.n)

    def light_at(self, place: Floats, random: np.random.Generator) -> Floats:
        """[16, 3] harmonics of the radiance that arrives at `place` [3]."""
        along = random.normal(size=(PLACE_RAYS, 3))
        along /= np.linalg.norm(along, axis=1, keepdims=True)
        arriving = self._arriving(np.broadcast_to(place, along.shape), along)
        return 4 * np.pi / PLACE_RAYS * sh_basis(along, BANDS).T @ arriving

    def _arriving(self, origins: Floats, directions: Floats) -> Floats:
        self._calls += 1
        sampler = mitsuba.load_dict({"type": "independent"})
        sampler.seed(self._calls, len(origins))
        rays = mitsuba.RayDifferential3f(_vectors(mitsuba.Point3f, origins), _vectors(mitsuba.Vector3f, directions))
        return _array(self._tracer.sample(self._scene, sampler, rays)[0])


def denoised(radiance: Floats, albedo: Floats, normal: Floats) -> Floats:
    """[h, w, 3] without the grain of few samples; all [h, w, 3]."""
    images = [np.ascontiguousarray(image, np.float32) for image in (radiance, albedo, normal)]
    return np.asarray(pyoidn.denoise(images[0], albedo=images[1], normal=images[2], hdr=True), np.float64)


def _described(shape: Shape) -> dict[str, Any]:
    """As Mitsuba is told of it."""
    reflectance: dict[str, Any] = {"type": "rgb", "value": shape.albedo.tolist()}
    if shape.albedo.ndim > 1:
        image = mitsuba.Bitmap(shape.albedo.astype(np.float32))
        scale = mitsuba.ScalarTransform4f().scale([*shape.repeats, 1.0])
        reflectance = {"type": "bitmap", "bitmap": image, "raw": True, "wrap_mode": "repeat", "to_uv": scale}
    paint = {"type": "twosided", "nested": {"type": "diffuse", "reflectance": reflectance}}
    place = mitsuba.ScalarTransform4f(shape.world_from_shape.tolist())
    described = {"type": shape.kind, "to_world": place, "bsdf": paint}
    if shape.radiance is not None:
        described["emitter"] = {"type": "area", "radiance": {"type": "rgb", "value": shape.radiance.tolist()}}
    return described


def _vectors(kind: Any, rows: Floats) -> Any:
    return kind(*(mitsuba.Float(np.ascontiguousarray(column, np.float32)) for column in rows.T))


def _array(columns: Any) -> Floats:
    return np.stack([np.array(columns[k], np.float64) for k in range(3)], axis=1)
