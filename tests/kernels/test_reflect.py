"""Glossy virtual surface against its float64 twin in the open, in white furnaces, and before a wall."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import ArrayLike

from protocol.frames import CameraModel
from server.objects.rasterize import VirtualSurface
from server.opencl.device import Device
from server.opencl.engine import Engine
from server.scene.materials import MATTE, Material, Texture
from server.scene.mipmaps import material_tables
from server.shading.reflect import LEAST_GLOSS, is_glossy, reflect_surroundings
from server.shading.traced_scene import trace_scene, upload_light
from server.transfer.indirect import Indirect
from server.transfer.radiance_transfer import direction_sets
from tests.kernels.test_indirect import paint
from tests.kernels.test_indirect import shape_of as voxels_of
from tests.kernels.test_lanes import Narrow, Wide
from tests.reference import reflect as twin
from tests.scenes import lights
from tests.scenes.analytic import Floats
from tests.scenes.solids import Scene, box, download4, fill_volume, float4, floor
from tests.scenes.tolerance import relative_tolerance

VOXEL_M, ROOM_M = 0.01, 1000.0
FAR_BELOW: Scene = (floor(-0.5),)
HEIGHT, WIDTH = 12, 16
EYE = np.array([0.48, 0.5, -0.6])
CAMERA = CameraModel(width=WIDTH, height=HEIGHT, fx=20.0, fy=20.0, cx=7.5, cy=5.5)
KINDS = pytest.mark.parametrize("kind", [Narrow, Wide])


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


@KINDS
def test_in_the_open_it_is_the_twins(device: Device, kind: type[Engine]) -> None:
    engine, light = kind(device), lights.lobe_and_sky((0.3, 0.5, -0.8))
    normals, colors, materials = surfaces()
    found, positions = reflect(engine, normals, colors, materials, light=light)
    full = [np.insert(a.astype(np.float32).astype(float), 3, 1, -1) for a in (normals, colors, materials)]
    expected = twin.reflect_surroundings(positions, *full, EYE, light, LEAST_GLOSS)
    # Angles of rays in float32 and a pixel's normal in it: some units of the last place, through an exponent of 9.
    np.testing.assert_allclose(found, expected, atol=20 * relative_tolerance(device) * np.abs(light).max())
    assert (found[..., :3].max(-1) > 0).mean() > 0.8
    np.testing.assert_array_equal(found[3], np.tile([0, 0, 0, 1], (WIDTH, 1)))  # matt
    np.testing.assert_array_equal(found[0, 0], [0, 0, 0, 1])  # not covered


def test_a_white_mirror_in_a_white_furnace_is_not_seen(engine: Engine) -> None:
    normals, colors, materials = surfaces()
    normals = lights.unit(normals - [0, 0, 2.0])  # none turns its back on the eye
    materials[..., 1] = 1.0
    wall = (box((-1, -1, 0.7), (2, 2, 2)), box((0.7, -1, -1), (2, 2, 2)))
    for scene in (FAR_BELOW, wall):
        found, positions = reflect(
            engine, normals, np.ones_like(colors), materials, light=lights.uniform(), scene=scene
        )
        seen = found[positions[..., 3] > 0]
        np.testing.assert_allclose(seen[:, :3], 1.0, atol=0.03)  # Karis' fit, and colours of 9 bits
        np.testing.assert_array_equal(seen[:, 3], 0.0)


def test_nothing_glossy_sends_more_than_it_gets(engine: Engine) -> None:
    found, _ = reflect(engine, *surfaces(), light=lights.uniform())
    assert np.isfinite(found).all()
    assert (found >= 0).all()
    _, colors, _ = surfaces()
    assert (found[..., :3] + found[..., 3:] * colors).max() < 1.05


def test_a_mirror_shows_the_wall_it_faces(engine: Engine) -> None:
    """Eye and mirror look at one another; what the mirror sees lies behind the eye: a red wall."""
    normals, colors, materials = surfaces()
    normals[:] = [0, 0, -1.0]
    materials[..., 0], materials[..., 1] = 0.0, 1.0
    behind = (box((-1, -1, -1), (2, 2, 0.1)),)
    arguments = (normals, np.ones_like(colors), materials)
    found, positions = reflect(engine, *arguments, light=lights.uniform(), scene=behind, color=(0.5, 0.1, 0.0))
    seen = found[positions[..., 3] > 0]
    np.testing.assert_allclose(seen[:, :3], np.tile([0.5, 0.1, 0.0], (len(seen), 1)), atol=0.02)
    dark, _ = reflect(engine, *arguments, light=lights.uniform(), scene=behind, indirect=False)
    assert not dark[..., :3].any()  # surfaces that send nothing are black in it


def test_materials_that_may_shine() -> None:
    shiny = Texture(np.full((2, 2, 3), 128, np.uint8))
    for material, expected in (
        (MATTE, False),
        (Material(roughness=0.5), True),
        (Material(metalness=1.0), True),
        (Material(surface_texture=shiny), True),
        (Material(color_texture=shiny), False),
    ):
        assert is_glossy(material_tables([MATTE, material]).materials) is expected
