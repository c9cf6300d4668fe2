"""A camera before a wall, and what composites over it."""

from __future__ import annotations

from typing import Any

import numpy as np
import pyopencl.array as cl_array
from numpy.typing import NDArray

from protocol.frames import CameraModel
from server.input.measure import linear_values
from server.objects.rasterize import VirtualSurface
from server.opencl.engine import Engine
from server.shading.composite import CompositeInputs, composite
from server.shading.traced_scene import upload_light
from server.transfer.radiance_transfer import direction_sets
from server.transfer.sample_grid import SampleGrid
from server.transfer.sampling import Upsampling
from server.volume.raycast import Surface
from tests.reference.composite import Buffer, Samples
from tests.scenes import lights
from tests.scenes.analytic import Floats
from tests.scenes.meshes import pose
from tests.scenes.solids import float4, upload_surface

HEIGHT, WIDTH = 44, 60
CAMERA = CameraModel(width=WIDTH, height=HEIGHT, fx=60.0, fy=60.0, cx=29.5, cy=21.5)
VOLUME_FROM_CAMERA = pose((0.3, 0.2, -0.1), (0, 1, 0), 0.2)
TOLERANCE_M = 0.01
LIGHT = lights.lobe_and_sky((-0.3, -0.8, -0.5))
Codes = NDArray[np.uint8]


def plane(z: float, slope: float = 0.0) -> tuple[Floats, Floats]:
    """Points [h, w, 3] (volume space) of the plane z + slope x in camera space, and its normals, towards the camera."""
    v, u = np.mgrid[:HEIGHT, :WIDTH]
    rays = np.stack([(u - CAMERA.cx) / CAMERA.fx, (v - CAMERA.cy) / CAMERA.fy, np.ones_like(u, float)], -1)
    depth = z / (1 - slope * rays[..., 0])
    normal = lights.unit([slope, 0, -1.0])
    rotation = VOLUME_FROM_CAMERA[:3, :3]
    points = (depth[..., None] * rays) @ rotation.T + VOLUME_FROM_CAMERA[:3, 3]
    return points, np.broadcast_to(rotation @ normal, points.shape)


def buffer(points: Floats, normals: Floats, valid: Any = True, color: float = 0.5) -> Buffer:
    valid = np.broadcast_to(valid, points.shape[:2])
    positions, normals = (
        np.where(valid[..., None], np.insert(a, 3, 1, -1), 0).astype(np.float32).astype(float)
        for a in (points, normals)
    )
    return Buffer(positions, normals, np.where(valid[..., None], color, 0) * np.array([1, 0.8, 0.5]))


def camera_picture(seed: int = 1) -> tuple[Codes, Floats]:
    """sRGB codes and linear radiance [h, w, 4]."""
    codes = np.random.default_rng(seed).integers(0, 256, (HEIGHT, WIDTH, 3), np.uint8)
    return codes, np.insert(linear_values("srgb8")[codes].astype(float), 3, 1, -1)


def upload_virtual(engine: Engine, virtual: Buffer, inverse_depths: Floats | None = None) -> VirtualSurface:
    space, covered = engine.workspace, virtual.positions[..., 3]
    return VirtualSurface(
        space.upload("virtual_positions", float4(virtual.positions[..., :3], covered)),
        space.upload("virtual_normals", float4(virtual.normals[..., :3], covered)),
        space.upload("virtual_colors", float4(virtual.colors, covered)),
        space.upload("virtual_index", np.where(covered > 0, 0, -1).astype(np.int32)),
        ((0, 0, WIDTH, HEIGHT),),
        nearest=None if inverse_depths is None else space.upload("nearest", inverse_depths.astype(np.float32)),
    )


def upload_samples(engine: Engine, name: str, samples: Samples | None) -> SampleGrid | None:
    if samples is None:
        return None
    return SampleGrid(
        samples.stride, engine.workspace.upload(name, float4(samples.values[..., :3], samples.values[..., 3]))
    )


def mixture_of(
    engine: Engine,
    radiance: Floats,
    real: Buffer,
    virtual: Buffer | None = None,
    occluded: Samples | None = None,
    ratio: Samples | None = None,
    light: Floats = LIGHT,
    refined_occluded: Samples | None = None,
    refined_ratio: Samples | None = None,
    upsampling: Upsampling = "bilateral",
    inverse_depths: Floats | None = None,
    restores_clipped: bool = False,
) -> CompositeInputs:
    surface: Surface = upload_surface(
        engine, real.positions[..., :3], real.normals[..., :3], real.positions[..., 3] > 0
    )
    return CompositeInputs(
        CAMERA,
        VOLUME_FROM_CAMERA,
        engine.workspace.upload("radiance", float4(radiance[..., :3], radiance[..., 3])),
        surface,
        TOLERANCE_M,
        upload_light(engine, light, direction_sets(81, round(len(light) ** 0.5))),
        upload_virtual(engine, virtual, inverse_depths) if virtual else None,
        upload_samples(engine, "occluded", occluded),
        upload_samples(engine, "ratio", ratio),
        upload_every(engine, "refined_occluded", refined_occluded),
        upload_every(engine, "refined_ratio", refined_ratio),
        upsampling,
        restores_clipped=restores_clipped,
    )


def compose(engine: Engine, shown: Codes, *others: Any, **named: Any) -> Codes:
    """The picture of mixture_of."""
    return composite(engine, shown, mixture_of(engine, *others, **named))


def upload_every(engine: Engine, name: str, samples: Samples | None) -> cl_array.Array | None:
    grid = upload_samples(engine, name, samples)
    return grid.values if grid else None


def samples(stride: int, value: float | Floats, valid: Any = 1.0) -> Samples:
    values = np.empty((HEIGHT // stride, WIDTH // stride, 4))
    values[..., :3] = value
    values[..., 3] = valid
    return Samples(stride, values.astype(np.float32).astype(float))


NONE_TAKEN = samples(2, 0.0)
WALL = buffer(*plane(1.0))
