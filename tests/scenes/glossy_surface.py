"""Glossy virtual surface in the middle of a volume, and what it reflects."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from protocol.frames import CameraModel
from server.objects.rasterize import VirtualSurface
from server.opencl.engine import Engine
from server.shading.reflect import reflect_surroundings
from server.shading.traced_scene import trace_scene, upload_light
from server.transfer.indirect import Indirect
from server.transfer.radiance_transfer import direction_sets
from tests.scenes import lights
from tests.scenes.analytic import Floats
from tests.scenes.painted_walls import paint, voxels_of
from tests.scenes.solids import Scene, download4, fill_volume, float4, floor

VOXEL_M, ROOM_M = 0.01, 1000.0
FAR_BELOW: Scene = (floor(-0.5),)
HEIGHT, WIDTH = 12, 16
EYE = np.array([0.48, 0.5, -0.6])
CAMERA = CameraModel(width=WIDTH, height=HEIGHT, fx=20.0, fy=20.0, cx=7.5, cy=5.5)


def reflect(
    engine: Engine,
    normals: Floats,
    colors: Floats,
    materials: Floats,
    *,
    light: Floats,
    scene: Scene = FAR_BELOW,
    color: ArrayLike = (1.0, 1.0, 1.0),
    indirect: bool = True,
) -> tuple[Floats, Floats]:
    """What pixels [h, w] of surface in the middle of the volume reflect, and their positions [h, w, 4]."""
    random = np.random.default_rng(4)
    points = np.array([0.48, 0.5, 0.48]) + 0.05 * random.uniform(-1, 1, normals.shape)
    points, normals, colors, materials = (a.astype(np.float32) for a in (points, normals, colors, materials))
    space, covered = engine.workspace, np.ones(normals.shape[:2])
    covered[0, 0] = 0
    virtual = VirtualSurface(
        position=space.upload("virtual_positions", float4(points, covered)),
        normal=space.upload("virtual_normals", float4(normals, covered)),
        base_color=space.upload("virtual_colors", float4(colors, covered)),
        object_index=space.upload("virtual_index", np.zeros(covered.shape, np.int32)),
        boxes=(),
        material=space.upload("virtual_materials", float4(materials, covered)),
    )
    volume, rays = fill_volume(engine, scene, VOXEL_M), direction_sets(81, 4)
    paint(engine, volume, np.broadcast_to(np.asarray(color, float), (*voxels_of(volume), 3)))
    unused = space.array("unused", (1,), np.float32)
    sent = Indirect(unused, np.ones(3)) if indirect else None
    traced = trace_scene(engine, volume, upload_light(engine, light, rays, indirect=sent), rays, ROOM_M, [])
    pose = np.eye(4)
    pose[:3, 3] = EYE
    found = download4(engine, reflect_surroundings(engine, CAMERA, pose, virtual, traced)).astype(float)
    return found, np.insert(points.astype(float), 3, covered, -1)


def surfaces(seed: int = 1) -> tuple[Floats, Floats, Floats]:
    """Normals that face the eye more or less, colours, and materials [h, w, 3]: roughness, metalness, 0."""
    random = np.random.default_rng(seed)
    shape = (HEIGHT, WIDTH)
    normals = lights.unit(np.array([0, 0, -1.0]) + 0.6 * random.normal(size=(*shape, 3)))
    normals[..., 2] = -np.abs(normals[..., 2])
    materials = np.zeros((*shape, 3))
    materials[..., 0], materials[..., 1] = random.uniform(0, 1, shape), random.choice([0.0, 0.5, 1.0], shape)
    materials[3, :, :2] = 1.0, 0.0
    return normals, random.uniform(0, 1, (*shape, 3)), materials
