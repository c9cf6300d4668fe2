"""Compositing against its float64 twin, and pictures whose every pixel is known."""

from __future__ import annotations

import msgspec
import numpy as np
import pytest
import trimesh

from protocol.frames import CameraModel
from server.input.measure import linear_values
from server.objects.rasterize import COARSE_SUBPIXELS, FINE_SUBPIXELS, rasterize, subpixels
from server.objects.virtual_object import VirtualObject
from server.opencl.engine import Engine
from server.shading.composite import shown_picture, srgb_codes
from server.transfer.sampling import Upsampling
from tests.reference import composite as twin
from tests.reference.composite import Buffer
from tests.scenes import lights
from tests.scenes.composite_scene import (
    CAMERA,
    HEIGHT,
    LIGHT,
    NONE_TAKEN,
    TOLERANCE_M,
    VOLUME_FROM_CAMERA,
    WALL,
    WIDTH,
    buffer,
    camera_picture,
    compose,
    plane,
    samples,
)
from tests.scenes.meshes import pose, shape_of
from tests.scenes.solids import download4, float4

# ---- against the twin --------------------------------------------------------------------------------------------


@pytest.mark.parametrize("stride", [1, 4, 8])
@pytest.mark.parametrize("bands", [2, 4])
def test_picture_is_the_twins(engine: Engine, stride: int, bands: int) -> None:
    random = np.random.default_rng(2)
    shown, radiance = camera_picture()
    radiance[..., 3] = random.choice([1, 0, -1], (HEIGHT, WIDTH), p=[0.8, 0.1, 0.1])
    v, u = np.mgrid[:HEIGHT, :WIDTH]
    near, far = plane(0.8, 0.3), plane(0.815, 0.25)  # a step of a tolerance and a half
    points, normals = (np.where((u < 25)[..., None], a, b) for a, b in zip(near, far, strict=True))
    real = buffer(points, normals, random.random((HEIGHT, WIDTH)) < 0.95)
    disc = (u - 30) ** 2 + (v - 20) ** 2 < 300
    virtual = buffer(*plane(0.8, 0.7), disc)
    ratio = samples(stride, random.uniform(0.3, 1, (HEIGHT // stride, WIDTH // stride, 3)))
    ratio.values[: len(ratio.values) // 3, :, :3] = 1  # a part of the picture is not touched
    ratio.values[..., 3] = random.random(ratio.values.shape[:2]) < 0.8
    occluded = samples(2, random.uniform(0, 0.2, (HEIGHT // 2, WIDTH // 2, 3)))
    occluded.values[..., 3] = virtual.positions[1::2, 1::2, 3]
    light = LIGHT[: bands * bands]
    found = compose(engine, shown, radiance, real, virtual, occluded, ratio, light)
    camera_from_volume = np.linalg.inv(VOLUME_FROM_CAMERA)
    expected = twin.composite(shown, radiance, real, camera_from_volume, TOLERANCE_M, light, virtual, occluded, ratio)
    changed = (expected != shown).any(-1)
    assert 0.2 < changed.mean() < 0.95
    # Rounding to a code, through a table of 65536 levels: neighbours may swap.
    difference = np.abs(found.astype(int) - expected)
    assert difference.max() <= 1
    assert (difference > 0).mean() < 5e-3
    np.testing.assert_array_equal(found[~changed], shown[~changed])


@pytest.mark.parametrize("stride", [4, 8])
@pytest.mark.parametrize("upsampling", ["bilateral", "bicubic"])
def test_refined_and_bicubic_values_are_the_twins(engine: Engine, stride: int, upsampling: Upsampling) -> None:
    """Refined values in a part of the picture, samples elsewhere, mixed across edges or not."""
    random = np.random.default_rng(5)
    shown, radiance = camera_picture()
    v, u = np.mgrid[:HEIGHT, :WIDTH]
    virtual = buffer(*plane(0.8, 0.7), (u - 30) ** 2 + (v - 20) ** 2 < 200)
    ratio = samples(stride, random.uniform(0.3, 0.9, (HEIGHT // stride, WIDTH // stride, 3)))
    ratio.values[..., 3] = random.random(ratio.values.shape[:2]) < 0.9
    occluded = samples(2, random.uniform(0, 0.2, (HEIGHT // 2, WIDTH // 2, 3)))
    occluded.values[..., 3] = virtual.positions[1::2, 1::2, 3]
    refined = [
        samples(1, random.uniform(low, high, (HEIGHT, WIDTH, 3)), part)
        for low, high, part in ((0, 0.2, (u < 32) & (virtual.positions[..., 3] > 0)), (0.3, 0.9, v < 24))
    ]
    found = compose(engine, shown, radiance, WALL, virtual, occluded, ratio, LIGHT, *refined, upsampling)
    pose = np.linalg.inv(VOLUME_FROM_CAMERA)
    arguments = (shown, radiance, WALL, pose, TOLERANCE_M, LIGHT, virtual, occluded, ratio)
    expected = twin.composite(*arguments, *refined, upsampling == "bicubic")
    difference = np.abs(found.astype(int) - expected)
    assert difference.max() <= 1
    assert (difference > 0).mean() < 5e-3
    assert (expected != twin.composite(*arguments, bicubic=upsampling == "bicubic")).any()


@pytest.mark.parametrize("parts", [COARSE_SUBPIXELS, FINE_SUBPIXELS])
def test_partly_covered_pixels_are_the_twins(engine: Engine, parts: int) -> None:
    """`parts` squared a pixel; edges of a leaning disc against a wall that cuts through it, beyond the picture too."""
    random = np.random.default_rng(8)
    shown, radiance = camera_picture()
    radiance[..., 3] = random.choice([1, 0, -1], (HEIGHT, WIDTH), p=[0.8, 0.1, 0.1])
    v, u = np.mgrid[: parts * HEIGHT, : parts * WIDTH] / parts
    fine = (u - 30) ** 2 + (v - 20) ** 2 < 300
    depth = 1.0 + 0.01 * (u - 30)
    inverse_depths = np.where(fine, 1 / depth, 0).astype(np.float32).astype(float)
    virtual = buffer(*plane(0.8, 0.7), fine[::parts, ::parts])
    real = buffer(*plane(1.0), random.random((HEIGHT, WIDTH)) < 0.9)
    ratio = samples(4, random.uniform(0.3, 1, (HEIGHT // 4, WIDTH // 4, 3)))
    occluded = samples(2, random.uniform(0, 0.2, (HEIGHT // 2, WIDTH // 2, 3)))
    occluded.values[..., 3] = virtual.positions[1::2, 1::2, 3]
    found = compose(engine, shown, radiance, real, virtual, occluded, ratio, inverse_depths=inverse_depths)
    pose = np.linalg.inv(VOLUME_FROM_CAMERA)
    arguments = (shown, radiance, real, pose, TOLERANCE_M, LIGHT, virtual, occluded, ratio)
    expected = twin.composite(*arguments, inverse_depths=inverse_depths)
    difference = np.abs(found.astype(int) - expected)
    assert difference.max() <= 1
    assert (difference > 0).mean() < 5e-3
    assert (expected != twin.composite(*arguments)).any(-1).sum() > 50


def test_a_slanted_edge_covers_what_it_covers(engine: Engine) -> None:
    """Of a white quad before a black wall, the picture's mean is the quad's area: not of whole pixels only."""
    corners = np.array([[-0.196, -0.143, 0.8], [0.204, -0.143, 0.8], [0.174, 0.117, 0.8], [-0.226, 0.127, 0.8]])
    mesh = shape_of(trimesh.Trimesh(corners, [[0, 1, 2], [0, 2, 3]]))
    objects = [(VirtualObject.upload(engine, mesh), VOLUME_FROM_CAMERA)]
    pose = np.linalg.inv(VOLUME_FROM_CAMERA)
    middle = rasterize(engine, CAMERA, pose, objects, parts=FINE_SUBPIXELS)
    assert middle.nearest is not None
    fine = engine.download(middle.nearest).view(np.float32)
    assert fine.shape == (FINE_SUBPIXELS * HEIGHT, FINE_SUBPIXELS * WIDTH)
    np.testing.assert_allclose(1 / fine[fine > 0], 0.8, rtol=1e-5)
    pixels = corners[:, :2] / corners[:, 2:] * [CAMERA.fx, CAMERA.fy]
    x, y = pixels.T
    area = 0.5 * abs(x @ np.roll(y, 1) - y @ np.roll(x, 1))
    assert (fine > 0).sum() / FINE_SUBPIXELS**2 == pytest.approx(area, rel=0.005)
    black = np.zeros((HEIGHT, WIDTH, 4))
    black[..., 3] = 1
    surface = (download4(engine, a).astype(float) for a in (middle.position, middle.normal))
    virtual = Buffer(*surface, np.ones((HEIGHT, WIDTH, 3)))
    light, nothing = lights.uniform((0.5, 0.5, 0.5)), np.zeros((HEIGHT, WIDTH, 3), np.uint8)
    picture = compose(engine, nothing, black, WALL, virtual, NONE_TAKEN, light=light, inverse_depths=fine)
    linear = linear_values("srgb8")[picture].mean(-1)
    assert linear.sum() / 0.5 == pytest.approx(area, rel=0.01)
    assert ((linear > 0.05) & (linear < 0.45)).sum() > 40  # the edge is smooth


def test_a_nearly_upright_edge_has_a_shade_for_each_column_of_parts(engine: Engine) -> None:
    """It moves by a good pixel over the picture's height: coverage is at most half a part off; with
    three shades it would be a quarter. Columns between two pixels count half for each: two more shades."""
    left = np.array([-11.0, -8.0]) / CAMERA.fx
    corners = np.array([[left[0], -1, 1], [1, -1, 1], [1, 1, 1], [left[1], 1, 1]])
    objects = [(VirtualObject.upload(engine, shape_of(trimesh.Trimesh(corners, [[0, 1, 2], [0, 2, 3]]))), np.eye(4))]
    nearest = rasterize(engine, CAMERA, np.eye(4), objects, parts=FINE_SUBPIXELS).nearest
    assert nearest is not None
    shares = twin.covered(engine.download(nearest), FINE_SUBPIXELS)
    covered = shares.sum(axis=1)
    height = (np.arange(HEIGHT) - CAMERA.cy) / CAMERA.fy
    edge = CAMERA.cx - 9.5 + 1.5 * height
    assert np.abs(covered - (WIDTH - 0.5 - edge)).max() <= 0.5 / FINE_SUBPIXELS + 1 / 256
    assert len(np.unique(shares)) > FINE_SUBPIXELS + 1


def test_an_edge_before_another_object_is_as_smooth_as_one_before_the_room(engine: Engine) -> None:
    """A white quad 20 cm before a darker one: each pixel is their mean by the parts of it that they cover. With the
    colour of its centre alone it would be the one or the other."""
    near = np.array([[-0.2, -0.15, 0.8], [-0.01, -0.15, 0.8], [0.03, 0.15, 0.8], [-0.2, 0.15, 0.8]])
    far = np.array([[-2.0, -2.0, 1.0], [2.0, -2.0, 1.0], [2.0, 2.0, 1.0], [-2.0, 2.0, 1.0]])
    objects = [
        (VirtualObject.upload(engine, shape_of(trimesh.Trimesh(corners, [[0, 1, 2], [0, 2, 3]]))), VOLUME_FROM_CAMERA)
        for corners in (near, far)
    ]
    pose = np.linalg.inv(VOLUME_FROM_CAMERA)
    middle = rasterize(engine, CAMERA, pose, objects, parts=FINE_SUBPIXELS)
    assert middle.nearest is not None
    fine = engine.download(middle.nearest).view(np.float32)
    positions, normals = (download4(engine, a).astype(float) for a in (middle.position, middle.normal))
    is_near = engine.download(middle.object_index) == 0
    virtual = Buffer(positions, normals, np.where(is_near[..., None], 1.0, 0.2) * np.ones(3))
    black = np.zeros((HEIGHT, WIDTH, 4))
    black[..., 3] = 1
    light, nothing = lights.uniform((0.5, 0.5, 0.5)), np.zeros((HEIGHT, WIDTH, 3), np.uint8)
    wall = buffer(*plane(1.5))
    picture = compose(engine, nothing, black, wall, virtual, NONE_TAKEN, light=light, inverse_depths=fine)
    share = twin.covered(fine > 1 / 0.9, FINE_SUBPIXELS)
    assert ((share > 0.1) & (share < 0.9)).sum() > 40
    found = linear_values("srgb8")[picture].mean(-1)
    np.testing.assert_allclose(found, 0.5 * (share + 0.2 * (1 - share)), atol=0.005)


def test_the_largest_camera_has_smooth_edges_too(engine: Engine) -> None:
    """What is drawn finer may be larger than any camera's picture is allowed to be."""
    camera = msgspec.structs.replace(CAMERA, width=1920, height=1200, fx=1500.0, fy=1500.0, cx=960.0, cy=600.0)
    thing = VirtualObject.upload(engine, shape_of(trimesh.creation.box((0.05, 0.05, 0.05))))
    nearest = rasterize(engine, camera, np.eye(4), [(thing, pose((0.0, 0.0, 1.0)))], parts=subpixels(camera)).nearest
    assert nearest is not None
    fine = engine.download(nearest)
    assert fine.shape == (2400, 3840)
    assert (fine > 0).sum() / 4 == pytest.approx((0.05 / 0.975 * 1500) ** 2, rel=0.015)  # a row of subpixels: 0.7 %


# ---- known pictures ----------------------------------------------------------------------------------------------


def test_nothing_virtual_is_the_camera_picture(engine: Engine) -> None:
    shown, radiance = camera_picture()
    np.testing.assert_array_equal(compose(engine, shown, radiance, WALL), shown)
    nowhere = buffer(*plane(0.5), False)
    for ratio in (None, samples(4, 1.0), samples(4, 1 - 1e-6), samples(4, 0.5, 0.0)):
        np.testing.assert_array_equal(compose(engine, shown, radiance, WALL, nowhere, NONE_TAKEN, ratio), shown)


def test_shown_picture_of_srgb_is_itself(engine: Engine) -> None:
    codes, radiance = camera_picture()
    shown = shown_picture(engine, CAMERA, codes, engine.workspace.upload("radiance", float4(radiance[..., :3])))
    np.testing.assert_array_equal(shown, codes)


def test_shown_picture_of_a_distorted_camera_is_the_rectified_radiance(engine: Engine) -> None:
    codes, radiance = camera_picture()
    camera = msgspec.structs.replace(CAMERA, distortion=(0.1, 0.0, 0.0, 0.0, 0.0))
    half = engine.workspace.upload("radiance", float4(0.5 * radiance[..., :3]))
    expected = twin.srgb_codes((0.5 * radiance[..., :3]).astype(np.float32).astype(np.float64))
    np.testing.assert_array_equal(shown_picture(engine, camera, codes, half), expected)


def test_shown_picture_of_linear16_is_encoded(engine: Engine) -> None:
    camera = CameraModel(width=256, height=256, fx=1, fy=1, cx=0, cy=0, color_encoding="linear16")
    levels = np.repeat(np.arange(65536, dtype=np.uint16).reshape(256, 256, 1), 3, 2)
    np.testing.assert_array_equal(shown_picture(engine, camera, levels, None), twin.srgb_codes(levels / 65535))


def test_codes_invert_the_linearisation() -> None:
    np.testing.assert_array_equal(srgb_codes(linear_values("srgb8").astype(float)), np.arange(256))
    np.testing.assert_array_equal(srgb_codes(np.array([-1.0, 0.0, 1.0, 7.0])), [0, 0, 255, 255])


@pytest.mark.parametrize("order", ["virtual in front", "real in front", "within tolerance", "no real surface"])
def test_the_nearer_is_seen(engine: Engine, order: str) -> None:
    shown, radiance = camera_picture()
    virtual_z = {"virtual in front": 0.8, "real in front": 1.03, "within tolerance": 1.008, "no real surface": 3.0}[
        order
    ]
    real = buffer(*plane(1.0), order != "no real surface")
    picture = compose(engine, shown, radiance, real, buffer(*plane(virtual_z)), NONE_TAKEN)
    if order == "real in front":
        np.testing.assert_array_equal(picture, shown)
    else:
        shading = twin.open_transfer(plane(1.0)[1][0, 0], 4) @ LIGHT
        expected = twin.srgb_codes(shading * 0.5 * np.array([1, 0.8, 0.5]))
        assert np.abs(picture.astype(int) - expected).max() <= 1


def test_two_planes_that_cross_hide_each_other(engine: Engine) -> None:
    """The virtual plane leans through the wall: seen where it is nearer, by more than a pixel's rounding."""
    shown, radiance = camera_picture()
    points, normals = plane(1.0, 0.6)
    picture = compose(engine, shown, radiance, WALL, buffer(points, normals), NONE_TAKEN)
    camera_from_volume = np.linalg.inv(VOLUME_FROM_CAMERA)
    depth = (points @ camera_from_volume[:3, :3].T + camera_from_volume[:3, 3])[..., 2]
    hidden, seen = depth > 1 + TOLERANCE_M + 1e-5, depth < 1 + TOLERANCE_M - 1e-5
    assert min(hidden.mean(), seen.mean()) > 0.3
    np.testing.assert_array_equal(picture[hidden], shown[hidden])
    assert (picture[seen] != shown[seen]).any(-1).mean() > 0.99


def test_shadow_is_a_factor_of_linear_light(engine: Engine) -> None:
    _, radiance = camera_picture()
    codes = np.resize(np.arange(256, dtype=np.uint8), (HEIGHT, WIDTH, 1)).repeat(3, 2)
    radiance[..., :3] = linear_values("srgb8")[codes]
    picture = compose(engine, codes, radiance, WALL, ratio=samples(4, 0.5))
    halved = twin.srgb_codes(radiance[..., :3] / 2)
    assert np.abs(picture.astype(int) - halved).max() <= 1
    assert (picture != halved).mean() < 0.01
    # Well-known: half of white is code 188, half of middle grey's 188 is 137 (nearest codes).
    assert set(picture[codes[..., 0] == 255].ravel()) == {188}
    assert set(picture[codes[..., 0] == 188].ravel()) == {137}


def test_outside_the_rectified_picture_nothing_changes(engine: Engine) -> None:
    shown, radiance = camera_picture()
    radiance[:, :20, 3] = -1
    picture = compose(engine, shown, radiance, WALL, ratio=samples(4, 0.5))
    np.testing.assert_array_equal(picture[:, :20], shown[:, :20])
    assert (picture[:, 20:] != shown[:, 20:]).any(-1).mean() > 0.9


def test_shadow_does_not_bleed_across_an_edge(engine: Engine) -> None:
    """Left half at 0.7 m and in shadow, right half at 1 m and not: no pixel of the right one darkens."""
    shown, radiance = camera_picture()
    u = np.mgrid[:HEIGHT, :WIDTH][1]
    left = (u < 30)[..., None]
    points = np.where(left, plane(0.7)[0], plane(1.0)[0])
    for stride in (4, 8):
        factor = np.where(np.arange(WIDTH // stride) * stride + stride // 2 < 30, 0.2, 1.0)
        ratio = samples(stride, np.broadcast_to(factor[None, :, None], (HEIGHT // stride, WIDTH // stride, 3)))
        picture = compose(engine, shown, radiance, buffer(points, plane(1.0)[1]), ratio=ratio)
        # Samples across the edge are 30 tolerances off the pixel's plane: weights of 1 / 30^4, below a code.
        assert np.abs(picture.astype(int) - shown)[:, 30:].max() <= 1
        shadowed = twin.srgb_codes(0.2 * radiance[..., :3])
        assert np.abs(picture.astype(int) - shadowed)[:, :30].max() <= 1


def test_occlusion_does_not_bleed_across_a_crease(engine: Engine) -> None:
    """Two sides of a virtual roof, one occluded: the other keeps its shading."""
    shown, radiance = camera_picture()
    left = np.mgrid[:HEIGHT, :WIDTH][1] < 30
    sides = plane(0.6, 1.5), plane(0.6, -1.5)
    points, normals = (np.where(left[..., None], a, b) for a, b in zip(*sides, strict=True))
    virtual = buffer(points, normals)
    taken = samples(2, np.where(left[1::2, 1::2, None], 0.3, 0.0))
    picture = compose(engine, shown, radiance, WALL, virtual, taken)
    free = compose(engine, shown, radiance, WALL, virtual, NONE_TAKEN)
    np.testing.assert_array_equal(picture[:, 30:], free[:, 30:])
    assert (picture[:, :30] < free[:, :30]).any(-1).all()


def test_more_occlusion_than_light_is_black(engine: Engine) -> None:
    shown, radiance = camera_picture()
    picture = compose(engine, shown, radiance, WALL, buffer(*plane(0.8)), samples(2, 1e6))
    np.testing.assert_array_equal(picture, 0)


def test_virtual_surface_without_samples_is_unoccluded(engine: Engine) -> None:
    shown, radiance = camera_picture()
    virtual = buffer(*plane(0.8))
    free, none = (compose(engine, shown, radiance, WALL, virtual, samples(2, 0.0, w)) for w in (1.0, 0.0))
    np.testing.assert_array_equal(free, none)
