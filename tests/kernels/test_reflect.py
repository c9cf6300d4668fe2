"""Glossy virtual surface against its float64 twin in the open, in white furnaces, and before a wall."""

from __future__ import annotations

import numpy as np

from server.opencl.device import Device
from server.opencl.engine import Engine
from server.scene.materials import MATTE, Material, Texture
from server.scene.mipmaps import material_tables
from server.shading.reflect import LEAST_GLOSS, is_glossy
from tests.reference import reflect as twin
from tests.scenes import lights
from tests.scenes.glossy_surface import EYE, FAR_BELOW, WIDTH, reflect, surfaces
from tests.scenes.lanes import KINDS
from tests.scenes.solids import box
from tests.scenes.tolerance import relative_tolerance


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
        np.testing.assert_allclose(seen[:, :3], 1.0, atol=1e-5)  # colours of 1 are exact in 9 bits
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
    # Of colours in 9 bits of their root. Seen: 0.0009.
    np.testing.assert_allclose(seen[:, :3], np.tile([0.5, 0.1, 0.0], (len(seen), 1)), atol=2e-3)
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
