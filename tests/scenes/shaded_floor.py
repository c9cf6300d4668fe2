"""A floor below virtual objects, and what their shadow takes of its light."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import trimesh
from numpy.typing import ArrayLike, NDArray

from protocol.frames import CameraModel
from server.objects.rasterize import Placed
from server.objects.virtual_object import VirtualObject
from server.opencl.engine import Engine
from server.shading.differential_rendering import shadow_real
from server.shading.traced_scene import trace_scene, upload_light
from server.transfer.radiance_transfer import Directions, direction_sets, transfer_radiance
from tests.reference import differential_rendering as twin
from tests.scenes import lights
from tests.scenes.analytic import Floats
from tests.scenes.meshes import pose, shape_of
from tests.scenes.solids import Ball, Box, Scene, box, download4, fill_volume, floor, hit, upload_surface

VOXEL_M = 0.01
FAR_M = 1000.0
UP = np.array([0.0, 1.0, 0.0])
PLATE = box((0.4, 0.3, 0.4), (0.56, 0.32, 0.56))
TOWARD = (0.6, 0.7, 0.2)
FLOOR = (floor(),)
LIGHT = lights.lobe_and_sky(TOWARD)


def placed(engine: Engine, solid: Box | Ball) -> Placed:
    """A body as a virtual object, its place given by its pose."""
    if isinstance(solid, Ball):
        return VirtualObject.upload(engine, shape_of(trimesh.creation.icosphere(4, solid.radius))), pose(solid.center)
    mesh = shape_of(trimesh.creation.box(solid.high - solid.low))
    return VirtualObject.upload(engine, mesh), pose((solid.low + solid.high) / 2)


def buffer(points: Floats, normal: ArrayLike, shape: tuple[int, int], stride: int) -> tuple[Floats, Floats]:
    """Geometry buffers [h, w, 4] in which every sample's block of pixels holds the same point."""
    positions = np.insert(points.reshape(*shape, 3), 3, 1, -1)
    normals = np.broadcast_to([*np.asarray(normal, float), 1.0], positions.shape)
    blocks = (np.repeat(np.repeat(a, stride, 0), stride, 1) for a in (positions, normals))
    first, second = (b.astype(np.float32).astype(np.float64) for b in blocks)
    return first, second


def camera_of(buffer: Floats) -> CameraModel:
    return CameraModel(width=buffer.shape[1], height=buffer.shape[0], fx=100.0, fy=100.0, cx=0.0, cy=0.0)


def floor_points(low: float = 0.1, high: float = 0.86, side: int = 24) -> Floats:
    x, z = np.meshgrid(np.linspace(low, high, side), np.linspace(low, high, side))
    return np.stack([x, np.full_like(x, 0.1), z], -1).reshape(-1, 3)


@dataclass(frozen=True)
class Shaded:
    """Ratios on a floor, and all that the twin needs to make them."""

    ratio: Floats
    positions: Floats
    normals: Floats
    transfer: Floats
    free: NDArray[np.bool_]
    light: Floats
    rays: Directions
    cell_m: float
    ray_length_m: float

    def expected(self, solid: Box, grown_m: float) -> Floats:
        """The twin's ratio where objects are exactly `solid`, moved out by `grown_m`."""
        directions = self.rays.directions.astype(float)
        arriving = self.rays.basis.astype(float) @ self.light
        return twin.shadow_real(
            self.positions,
            self.normals,
            STRIDE,
            self.transfer,
            self.free,
            self.light,
            directions,
            arriving,
            lambda o, d: hit([solid], o, d, grown_m) >= self.ray_length_m,
        )

    @cached_property
    def points(self) -> Floats:
        return self.positions[STRIDE // 2 :: STRIDE, STRIDE // 2 :: STRIDE, :3]


STRIDE = 3


def shade_floor(
    engine: Engine,
    solid: Box | Ball,
    light: Floats = LIGHT,
    *,
    scene: Scene = FLOOR,
    rays: int = 81,
    ray_length_m: float = FAR_M,
    points: Floats | None = None,
    roughness: float = 0.0,
) -> Shaded:
    """The ratio on a floor with a box above it; `roughness`: noise of each pixel's normal."""
    points = floor_points() if points is None else points
    side = round(len(points) ** 0.5)
    positions, normals = buffer(points, UP, (side, side), STRIDE)
    noise = roughness * np.random.default_rng(3).normal(size=normals[..., :3].shape)
    normals = np.concatenate([lights.unit(normals[..., :3] + noise), normals[..., 3:]], -1)
    camera, directions = camera_of(positions), direction_sets(rays, round(len(light) ** 0.5))
    surface = upload_surface(engine, positions[..., :3], normals[..., :3], positions[..., 3] > 0)
    volume = fill_volume(engine, scene, VOXEL_M)
    transfer = transfer_radiance(engine, camera, volume, surface, STRIDE, directions, ray_length_m)
    objects = [placed(engine, solid)]
    device_light = upload_light(engine, light, directions)
    traced = trace_scene(engine, volume, device_light, directions, ray_length_m, objects)
    ratio = shadow_real(engine, camera, surface, transfer, traced)
    bits = np.unpackbits(engine.download(transfer.free_mask).view(np.uint8), axis=-1, bitorder="little")[..., :rays]
    return Shaded(
        download4(engine, ratio.values),
        positions,
        normals,
        engine.download(transfer.coefficients).astype(float),
        bits.astype(bool),
        light,
        directions,
        traced.table.cell_m[0],
        ray_length_m,
    )
