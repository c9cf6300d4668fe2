"""Textures on the device: against the float64 twin, and in the picture against 16 x 16 rays a pixel."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pyopencl.cltypes as cl_types
import pytest
from numpy.typing import NDArray

from protocol.frames import CameraModel
from server.objects.rasterize import FINE_SUBPIXELS, rasterize
from server.objects.virtual_object import VirtualObject
from server.opencl.engine import Engine
from server.opencl.program import with_headers
from server.scene.colors import linear_from_srgb
from server.scene.materials import Beyond, Material, Texture
from server.scene.mesh import Mesh
from server.scene.mipmaps import CHANNEL_VALUES, decoded, encoded, material_tables, mip_chain, shrunk
from tests.reference import textures as twin
from tests.scenes.meshes import mesh_of, pose
from tests.scenes.own_kernel import own_kernel

SOURCE = """
#include "textures.clh"
kernel void sample(const int count, const global int4 *textures, const global int4 *levels, const global uchar4 *texels,
                   const global float *values, const int texture, const global float2 *uv, const global float2 *du,
                   const global float2 *dv, const int probes, global float *result) {
    const int i = get_global_id(0);
    if (i >= count) return;
    const Textures all = {textures, levels, texels, values};
    const Footprint footprint = {uv[i], du[i], dv[i]};
    vstore3(sample_texture(all, texture, footprint, probes), i, result);
}
"""
Floats = NDArray[np.float64]
Bytes = NDArray[np.uint8]


def noise(seed: int, width: int, height: int) -> Bytes:
    return np.random.default_rng(seed).integers(0, 256, (height, width, 3), np.uint8)


def checkers(side: int, squares: int) -> Bytes:
    v, u = np.mgrid[:side, :side] * squares // side
    return np.repeat((((u + v) % 2) * 255).astype(np.uint8)[..., None], 3, axis=2)


# ---- mip levels --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("size", [(64, 64), (37, 20), (1, 9), (5, 3), (1, 1)])
@pytest.mark.parametrize("is_srgb", [True, False])
def test_levels_are_means_of_linear_light(size: tuple[int, int], is_srgb: bool) -> None:
    """To the rounding of a byte, from the exact integrals of the level before the rounding."""
    image = noise(1, *size)
    chain = mip_chain(image, is_srgb=is_srgb)
    expected = linear_from_srgb(image / 255.0).astype(np.float64) if is_srgb else image / 255.0
    np.testing.assert_array_equal(chain[0], image)
    for level in chain[1:]:
        expected = twin.halved(expected)
        assert level.shape == expected.shape
        slack = np.abs(level.astype(int) - encoded(expected.astype(np.float32), is_srgb=is_srgb))
        assert slack.max() <= 1
        assert (slack > 0).mean() < 0.05
    assert chain[-1].shape == (1, 1, 3)
    mean = decoded(chain[-1], is_srgb=is_srgb)[0, 0]
    if size == (64, 64):
        np.testing.assert_allclose(mean, decoded(image, is_srgb=is_srgb).mean(axis=(0, 1)), atol=4e-3)


def test_black_and_white_is_half_the_light() -> None:
    """Not the middle byte: 188 is what shines half as bright as 255."""
    assert set(np.unique(mip_chain(checkers(8, 8), is_srgb=True)[1])) == {188}
    assert set(np.unique(mip_chain(checkers(8, 8), is_srgb=False)[1])) == {128}


def test_bytes_come_back() -> None:
    every = np.arange(256, dtype=np.uint8)
    for is_srgb in (True, False):
        np.testing.assert_array_equal(encoded(decoded(every, is_srgb=is_srgb), is_srgb=is_srgb), every)


@pytest.mark.parametrize(("width", "height"), [(1000, 300), (300, 1000), (2048, 2048), (129, 65)])
def test_shrunk(width: int, height: int) -> None:
    image = noise(2, width, height)
    small = shrunk(image, 128, is_srgb=True)
    assert max(small.shape) <= 128
    assert small.shape[1] / small.shape[0] == pytest.approx(width / height, rel=0.05)
    light, kept = (decoded(i, is_srgb=True).mean(axis=(0, 1)) for i in (image, small))
    np.testing.assert_allclose(kept, light, rtol=0.02)
    assert shrunk(image, 4096, is_srgb=True) is image


# ---- samples against the twin ------------------------------------------------------------------------------------


@pytest.fixture
def sample(engine: Engine) -> Any:
    """[n, 3] of texture number `texture` of some materials at uv [n, 2], with its changes."""
    kernel = own_kernel(engine.device, with_headers(SOURCE, "sample.cl"), "sample")

    def run(materials: list[Material], texture: int, uv: Floats, du: Floats, dv: Floats, probes: int = 4) -> Floats:
        tables, space = material_tables(materials), engine.workspace
        rows = [tables.textures.view(cl_types.int4)[:, 0], tables.levels.view(cl_types.int4)[:, 0], tables.texels]
        table = [space.upload(f"test_table_{k}", a) for k, a in enumerate([*rows, CHANNEL_VALUES])]
        inputs = [space.upload(f"test_in_{k}", a.astype(np.float32)) for k, a in enumerate((uv, du, dv))]
        result = space.array("test_result", (len(uv), 3), np.float32)
        engine.launch(kernel, (len(uv),), len(uv), *table, texture, *inputs, probes, result)
        return engine.download(result).astype(np.float64)

    return run


def levels_of(image: Bytes) -> twin.Levels:
    return [decoded(level, is_srgb=True).astype(np.float64) for level in mip_chain(image, is_srgb=True)]


@pytest.mark.parametrize(
    "beyond", [(Beyond.REPEAT, Beyond.CLAMP), (Beyond.MIRROR, Beyond.REPEAT), (Beyond.CLAMP, Beyond.MIRROR)]
)
@pytest.mark.parametrize(("size", "probes"), [((64, 64), 4), ((37, 20), 1), ((1, 1), 8), ((5, 128), 4)])
def test_samples_match_twin(sample: Any, size: tuple[int, int], probes: int, beyond: tuple[Beyond, Beyond]) -> None:
    """Within rounding, but where rounding changes the number of probes."""
    image, rng = noise(3, *size), np.random.default_rng(4)
    other = Texture(noise(5, 16, 16))
    materials = [Material(color_texture=other), Material(color_texture=Texture(image, beyond))]
    uv = rng.uniform(-3, 4, (20000, 2)).astype(np.float32).astype(np.float64)
    scale = 10.0 ** rng.uniform(-4, 0.5, (20000, 1))
    du, dv = ((rng.normal(size=(20000, 2)) * scale).astype(np.float32).astype(np.float64) for _ in range(2))
    dv[::3] = 0.05 * dv[::3] + 0.9 * du[::3]  # long and thin
    du[::7], dv[::7] = 0, 0
    found = sample(materials, 1, uv, du, dv, probes)
    expected = twin.sample_texture(levels_of(image), uv, du, dv, beyond, probes)
    error = np.abs(found - expected).max(axis=1)
    # uv of size 4 in float32, times the steepest slope between texels: 128 of them to a unit.
    assert np.percentile(error, 99.5) < 1e-4  # seen: 6e-6
    assert (error > 1e-3).mean() < 5e-3
    assert np.median(error) < 1e-6  # seen: 7e-8


def test_texel_centres_show_their_texels(sample: Any) -> None:
    image = noise(6, 9, 6)
    v, u = np.mgrid[:6, :9]
    uv = np.stack([(u + 0.5) / 9, (v + 0.5) / 6], axis=-1).reshape(-1, 2)
    zero = np.zeros_like(uv)
    found = sample([Material(color_texture=Texture(image))], 0, uv, zero, zero)
    np.testing.assert_allclose(found, decoded(image, is_srgb=True).reshape(-1, 3), atol=1e-5)


def test_extreme_footprints_stay_finite(sample: Any) -> None:
    image = noise(7, 33, 47)
    huge = np.array([0.0, 1e-30, 1e10, 1e30, -1e25, 3e38])
    uv = np.tile([[0.3, 0.7]], (len(huge), 1))
    changes = np.stack([huge, -huge], axis=1)
    found = sample([Material(color_texture=Texture(image))], 0, uv, changes, changes[::-1])
    assert np.isfinite(found).all()
    assert found.min() >= 0
    assert found.max() <= 1.0001


def test_tables_share_textures() -> None:
    shared, own = Texture(noise(8, 8, 8)), Texture(noise(9, 4, 4))
    materials = [Material(0.3, 0.1, shared), Material(0.5, 0.9, shared, own), Material(surface_texture=shared)]
    tables = material_tables(materials)
    np.testing.assert_allclose(tables.materials[:, 2:], [[0, -1], [0, 1], [-1, 2]])  # as surface it is not sRGB
    np.testing.assert_array_equal(tables.textures[:, :2], [[0, 4], [4, 3], [7, 4]])
    assert len(tables.texels) == 2 * (64 + 16 + 4 + 1) + 16 + 4 + 1


# ---- in the picture ----------------------------------------------------------------------------------------------

CAMERA = CameraModel(width=157, height=119, fx=140.0, fy=140.0, cx=79.5, cy=20.0)


def floor_mesh(material: Material, repeats: float, length_m: float = 12.0, color: float = 1.0) -> Mesh:
    """A floor 0.4 m under the camera, from 0.3 m in front of it on, its texture repeated along both sides."""
    half = length_m / 2
    corners = np.array([[-half, 0.4, 0.3], [half, 0.4, 0.3], [half, 0.4, 0.3 + length_m], [-half, 0.4, 0.3 + length_m]])
    uv = np.array([[0, 0], [1, 0], [1, 1], [0, 1]]) * repeats
    plain = mesh_of(corners, [[0, 1, 2], [0, 2, 3]], np.full((4, 3), color))
    return replace(plain, uv=np.hstack([uv, uv]).astype(np.float32), materials=(material,))


def draw(engine: Engine, *placed: tuple[Mesh, Floats], parts: int = 1) -> dict[str, NDArray[np.float32]]:
    objects = [(VirtualObject.upload(engine, mesh, cells=8), matrix) for mesh, matrix in placed]
    surface = rasterize(engine, CAMERA, np.eye(4), objects, parts=parts)
    names = ("position", "base_color", "material")
    fields = {
        n: engine.download(getattr(surface, n)).view(np.float32).reshape(CAMERA.height, CAMERA.width, 4) for n in names
    }
    return fields | {"object_index": engine.download(surface.object_index)}


def supersampled(levels: twin.Levels, repeats: float, length_m: float, rays: int) -> tuple[Floats, NDArray[np.bool_]]:
    """[h, w, 3] the mean of rays x rays rays a pixel to the floor, and whether all of them meet it."""
    offsets = (np.arange(rays) + 0.5) / rays - 0.5
    v, u = np.mgrid[: CAMERA.height, : CAMERA.width]
    total, all_met = np.zeros((*u.shape, 3)), np.ones(u.shape, bool)
    for dy in offsets:
        for dx in offsets:
            x, y = (u + dx - CAMERA.cx) / CAMERA.fx, (v + dy - CAMERA.cy) / CAMERA.fy
            depth = 0.4 / np.where(y > 0, y, np.nan)
            at = np.stack([x * depth / length_m + 0.5, (depth - 0.3) / length_m], axis=-1)
            met = ((at >= 0) & (at <= 1)).all(axis=-1)
            total += twin.bilinear(levels[0], np.where(met[..., None], at, 0) * repeats, (0, 0))
            all_met &= met
    return total / rays**2, all_met


@pytest.mark.parametrize("parts", [1, FINE_SUBPIXELS])
def test_checkerboard_at_a_grazing_angle_does_not_alias(engine: Engine, parts: int) -> None:
    """As close to 256 rays a pixel as those are to the truth's own scale of change; one ray a pixel is far off."""
    image, repeats, length_m = checkers(64, 8), 12.0, 12.0
    mesh = floor_mesh(Material(color_texture=Texture(image)), repeats)
    found = draw(engine, (mesh, np.eye(4)), parts=parts)["base_color"]
    expected, met = supersampled(levels_of(image), repeats, length_m, 16)
    single, _ = supersampled(levels_of(image), repeats, length_m, 1)
    assert met.mean() > 0.5
    error, aliased = np.abs(found[..., 0] - expected[..., 0])[met], np.abs(single[..., 0] - expected[..., 0])[met]
    assert np.sqrt((error**2).mean()) < 0.035
    assert np.sqrt((error**2).mean()) < 0.2 * np.sqrt((aliased**2).mean())
    far = met & (np.indices(met.shape)[0] < CAMERA.cy + 8)
    assert np.abs(found[..., 0] - 0.5)[far].max() < 0.02  # a distant board is grey; seen: 0.003
    # Neither darker nor brighter on the whole: the levels are means of light.
    assert found[met].mean(axis=0)[0] == pytest.approx(expected[met].mean(axis=0)[0], abs=0.01)


def test_texture_is_perspective_correct(engine: Engine) -> None:
    """A smooth gradient read back as the place on the floor."""
    ramp = np.zeros((256, 256, 3), np.uint8)
    ramp[..., 0], ramp[..., 1] = np.arange(256)[None], np.arange(256)[:, None]
    material = Material(surface_texture=Texture(ramp, (Beyond.CLAMP, Beyond.CLAMP)))
    fields = draw(engine, (floor_mesh(material, 1.0), np.eye(4)))
    covered = fields["object_index"] == 0
    near = covered & (fields["position"][..., 2] < 4)
    v = (fields["position"][..., 2] - 0.3) / 12.0
    np.testing.assert_allclose(fields["material"][..., 0][near], (v * 256 - 0.5)[near] / 255, atol=3e-3)


def test_roughness_and_metalness(engine: Engine) -> None:
    """Factors times green and blue; each object's own; 1 and 0 where nothing is said; 0 where nothing is."""
    surface = np.tile(np.array([10, 51, 204], np.uint8), (4, 4, 1))
    shiny = Material(roughness=0.5, metalness=0.75, surface_texture=Texture(surface))
    near, far = floor_mesh(shiny, 1.0), floor_mesh(Material(), 1.0, color=0.25)
    plain = floor_mesh(Material(roughness=0.125, metalness=1.0), 1.0)
    shift = pose((0.0, 0.2, 0.0))
    fields = draw(engine, (far, shift @ shift), (near, pose((-6.0, 0.0, 0.0))), (plain, shift))
    material, index = fields["material"], fields["object_index"]
    for number, values in enumerate([(1.0, 0.0), (0.5 * 0.2, 0.75 * 0.8), (0.125, 1.0)]):
        shown = material[index == number]
        if number != 0:
            assert len(shown) > 300
        np.testing.assert_allclose(shown, np.tile([*values, 0, 1], (len(shown), 1)), atol=1e-6)
    assert not material[index < 0].any()


def test_texture_multiplies_vertex_colours(engine: Engine) -> None:
    image = np.tile(np.array([188, 255, 0], np.uint8), (8, 8, 1))
    mesh = floor_mesh(Material(color_texture=Texture(image)), 1.0, color=0.5)
    fields = draw(engine, (mesh, np.eye(4)))
    shown = fields["base_color"][fields["object_index"] == 0]
    expected = [*(0.5 * decoded(image[0, 0], is_srgb=True)), 1.0]
    np.testing.assert_allclose(shown, np.tile(expected, (len(shown), 1)), atol=1e-6)


def test_each_object_has_its_own_textures(engine: Engine) -> None:
    """Several textured meshes in one arena, one of them placed twice."""
    red, blue = (np.tile(np.array(c, np.uint8), (s, s, 1)) for c, s in (((255, 0, 0), 16), ((0, 0, 255), 5)))
    side = mesh_of([[-0.2, -0.2, 1], [0.2, -0.2, 1], [0, 0.2, 1]], [0, 1, 2], np.ones((3, 3)))
    uv = np.random.default_rng(0).random((3, 4)).astype(np.float32)
    meshes = [replace(side, uv=uv, materials=(Material(color_texture=Texture(image)),)) for image in (red, blue)]
    things = [VirtualObject.upload(engine, mesh, cells=8) for mesh in (*meshes, side)]
    places = [(things[k], pose((x, 0.2, 0.0))) for k, x in ((1, -0.4), (0, -0.1), (2, 0.2), (0, 0.45))]
    surface = rasterize(engine, CAMERA, np.eye(4), places)
    color = engine.download(surface.base_color).view(np.float32).reshape(CAMERA.height, CAMERA.width, 4)
    index = engine.download(surface.object_index)
    for number, expected in enumerate([(0, 0, 1), (1, 0, 0), (1, 1, 1), (1, 0, 0)]):
        assert (index == number).sum() > 100
        np.testing.assert_allclose(color[index == number][:, :3].mean(axis=0), expected, atol=1e-5)
