"""Registration of depth to colour: against its float64 twin, and against exact scenes seen by two lenses."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
import pytest
from msgspec.structs import replace
from numpy.typing import NDArray
from scipy.ndimage import binary_dilation, binary_erosion

from protocol.frames import CameraModel, RgbdFrame
from server.input.measure import GREATEST_DEPTH_M, measure
from server.input.register import rays_of, register_depth
from server.opencl.engine import Engine
from tests.reference import register as twin
from tests.scenes.analytic import look, plane
from tests.scenes.lenses import (
    BALL,
    CAMERA,
    LENS,
    ROOM,
    WORLD_FROM_COLOR,
    is_seen_by_both,
    moved,
    opencv_rays,
    seen_by_depth,
)
from tests.scenes.tolerance import relative_tolerance

FLIPS = 5e-3
"""Share of pixels that float32 may put on the other side of a triangle's edge."""


def registered(engine: Engine, camera: CameraModel, depth: NDArray[np.uint16]) -> NDArray[Any]:
    color = np.full((camera.height, camera.width, 3), 100, np.uint8)
    return engine.download(measure(engine, camera, RgbdFrame(0, 0.0, color, depth, None)).depth_m)


def test_rays_are_opencvs() -> None:
    for distortion in ((0.0,) * 5, LENS.distortion, (0.21, 0.05, -0.002, 0.0015, 0.01)):
        lens = replace(LENS, distortion=distortion)
        assert (rays_of(lens)[..., 2] == 1).all()
        np.testing.assert_allclose(rays_of(lens)[..., :2], opencv_rays(lens)[..., :2], atol=1e-6)


def test_a_pixel_beyond_the_fold_of_the_polynomial_has_no_ray() -> None:
    rays = rays_of(replace(LENS, distortion=(-0.9, 0.0, 0.0, 0.0, 0.0)))
    assert np.isfinite(rays).all()
    assert rays[30, 40, 2] == 1
    assert rays[0, 0, 2] == 0
    radius = np.linalg.norm(rays[rays[..., 2] > 0][:, :2], axis=-1)
    assert radius.max() < np.sqrt(1 / (3 * 0.9))  # where r (1 - 0.9 r^2) turns


@pytest.mark.parametrize("size", [(64, 48), (23, 17)])
@pytest.mark.parametrize("is_rough", [False, True])
def test_matches_twin(engine: Engine, size: tuple[int, int], is_rough: bool) -> None:
    lens = replace(
        LENS, width=29, height=21, fx=25.0, fy=24.0, cx=14.2, cy=10.3, color_from_depth=moved((0.06, 0.02, -0.01))
    )
    width, height = size
    camera = CameraModel(
        width=width, height=height, fx=0.8 * width, fy=0.8 * width, cx=width / 2.1, cy=height / 1.9, depth=lens
    )
    depth = seen_by_depth(camera, [ROOM, BALL], WORLD_FROM_COLOR)
    if is_rough:
        rng = np.random.default_rng(1)
        depth = (depth + rng.integers(0, 40, depth.shape)).astype(np.uint16)
        depth[rng.random(depth.shape) < 0.3] = 0
        depth[rng.random(depth.shape) < 0.05] = 65535
        depth[rng.random(depth.shape) < 0.05] = 3
    units = engine.workspace.upload("units", depth)
    found = engine.download(register_depth(engine, camera, units, GREATEST_DEPTH_M))
    greatest_px = int(np.ceil(4 * max(camera.fx / lens.fx, camera.fy / lens.fy))) + 2
    expected = twin.register_depth(camera, rays_of(lens).astype(np.float64), depth, GREATEST_DEPTH_M, greatest_px)
    # Barycentric shares are differences of products of pixel coordinates: they lose as many digits as those have.
    same = np.isclose(found, expected, rtol=100 * relative_tolerance(engine.device), atol=0)
    assert (~same).mean() < FLIPS
    assert (expected > 0).mean() > 0.3


def test_what_both_lenses_see_is_exact_and_without_gaps(engine: Engine) -> None:
    """Distorted, of half the resolution, 5 cm aside and turned. The ball becomes facets of 2 cm, which lie under it by
    0.15 mm, towards its rim by more along the view."""
    scene = [ROOM, BALL]
    found = registered(engine, CAMERA, seen_by_depth(CAMERA, scene, WORLD_FROM_COLOR))
    truth = look(scene, CAMERA, WORLD_FROM_COLOR)
    inner = binary_erosion(is_seen_by_both(CAMERA, scene, WORLD_FROM_COLOR), iterations=2) & truth.is_continuous
    assert inner.mean() > 0.5
    assert (found[inner] > 0).mean() > 0.995
    off = np.abs(found - truth.depth_m)[inner & (found > 0)]
    assert np.median(off) < 5e-5  # a unit of depth is 1e-4; seen: 2e-5
    assert np.percentile(off, 95) < 1e-3
    assert np.percentile(off, 99.5) < 3e-3


def test_nothing_leaks_across_an_edge(engine: Engine) -> None:
    """The ball stays within one pixel of its outline, nothing floats between it and the wall, and it hides the wall."""
    scene = [ROOM, BALL]
    found = registered(engine, CAMERA, seen_by_depth(CAMERA, scene, WORLD_FROM_COLOR))
    exact, behind = (look(shapes, CAMERA, WORLD_FROM_COLOR).depth_m for shapes in (scene, [ROOM]))
    ball = exact < behind - 1e-9
    has_ball = (found > 0) & (found < behind - 0.1)
    assert ball.sum() > 1000
    assert not (has_ball & ~binary_dilation(ball, np.ones((3, 3)))).any()
    core = binary_erosion(ball, np.ones((5, 5)))
    assert has_ball[core].all()
    off_ball = np.abs(found - exact)
    off_wall = np.abs(found - behind)
    ball_near = np.where(ball, exact, np.inf)
    nearest_ball = -cv2.dilate(-ball_near.astype(np.float32), np.ones((3, 3)))
    off_outline = np.abs(found - np.where(np.isfinite(nearest_ball), nearest_ball, 0))
    floats = (found > 0) & (np.minimum(np.minimum(off_ball, off_wall), off_outline) > 0.06)
    assert not floats.any()


def test_a_slanted_surface_is_not_drawn_nearer(engine: Engine) -> None:
    """A point at the pixel nearest to it would have a slope's half pixel of error, and the nearest would win."""
    scene = [plane((0, 0, 0.6), (0.8, 0.1, -1))]
    found = registered(engine, CAMERA, seen_by_depth(CAMERA, scene, WORLD_FROM_COLOR))
    inner = binary_erosion(is_seen_by_both(CAMERA, scene, WORLD_FROM_COLOR), iterations=2)
    off = (found - look(scene, CAMERA, WORLD_FROM_COLOR).depth_m)[inner & (found > 0)]
    assert np.abs(off).max() < 1e-4  # seen: half a unit of depth, 5e-5
    assert abs(off.mean()) < 5e-6  # seen: 1.3e-6


def test_a_finer_depth_grid_keeps_the_nearest(engine: Engine) -> None:
    fine = replace(LENS, width=640, height=480, fx=528.0, fy=520.0, cx=315.0, cy=241.0)
    camera = replace(CAMERA, depth=replace(fine, color_from_depth=CAMERA.depth.color_from_depth))  # type: ignore[union-attr]
    scene = [ROOM, BALL]
    found = registered(engine, camera, seen_by_depth(camera, scene, WORLD_FROM_COLOR))
    truth = look(scene, camera, WORLD_FROM_COLOR)
    inner = binary_erosion(is_seen_by_both(camera, scene, WORLD_FROM_COLOR), iterations=2) & truth.is_continuous
    assert np.percentile(np.abs(found - truth.depth_m)[inner], 99.9) < 2e-4


def test_one_thin_thing_survives(engine: Engine) -> None:
    """A column of single pixels in front of a wall makes no triangle, and is kept."""
    lens = replace(LENS, distortion=(0.0,) * 5, color_from_depth=moved((0.05, 0.0, 0.0)))
    depth = np.full((60, 80), 20_000, np.uint16)
    depth[:, 40] = 10_000
    near = registered(engine, replace(CAMERA, depth=lens), depth)
    near = (near > 0) & (near < 1.5)
    assert near.any(0).sum() == 1
    assert near.sum() >= 50  # one colour pixel for each depth pixel that the picture holds


@pytest.mark.parametrize(
    ("value", "scale_m"), [(0, 0.001), (65535, 0.001), (65535, 0.0001), (65534, 0.001), (10_001, 0.001), (1, 1.7e7)]
)
def test_no_depth_anywhere(engine: Engine, value: int, scale_m: float) -> None:
    camera = replace(CAMERA, depth_scale_m=scale_m)
    assert not registered(engine, camera, np.full((60, 80), value, np.uint16)).any()


def test_what_is_too_far_for_its_own_lens_is_none(engine: Engine) -> None:
    nearer = replace(CAMERA, depth_scale_m=0.001, depth=replace(LENS, color_from_depth=moved((0, 0, -0.02))))
    assert registered(engine, nearer, np.full((60, 80), 10_000, np.uint16)).any()
    assert not registered(engine, nearer, np.full((60, 80), 10_010, np.uint16)).any()


def test_a_pixel_without_a_ray_gives_nothing(engine: Engine) -> None:
    folded = replace(CAMERA, depth=replace(LENS, distortion=(-0.9, 0.0, 0.0, 0.0, 0.0)))
    depth = np.zeros((60, 80), np.uint16)
    depth[:2, :2] = 10_000
    assert not registered(engine, folded, depth).any()


def test_two_lenses_of_one_size_share_an_engine(engine: Engine) -> None:
    depth = np.full((60, 80), 10_000, np.uint16)
    other = replace(CAMERA, depth=replace(CAMERA.depth, distortion=(0.0,) * 5))  # type: ignore[type-var]
    first = registered(engine, CAMERA, depth)
    second = registered(engine, other, depth)
    assert (first != second).mean() > 0.01
    np.testing.assert_array_equal(registered(engine, CAMERA, depth), first)


def test_one_pixel(engine: Engine) -> None:
    depth = np.zeros((60, 80), np.uint16)
    depth[30, 40] = 10_000
    found = registered(engine, CAMERA, depth)
    assert (found > 0).sum() == 1
    assert found.max() == pytest.approx(1.004, abs=5e-4)  # moved along the axis, and turned by degrees


def test_a_lens_far_out_of_the_picture_gives_nothing(engine: Engine) -> None:
    for change in ({"cx": 1e30}, {"fx": 1e30, "fy": 1e30}):
        found = registered(engine, replace(CAMERA, **change), np.full((60, 80), 10_000, np.uint16))
        assert not found.any()


def test_runs_the_same_twice(engine: Engine) -> None:
    depth = seen_by_depth(CAMERA, [ROOM, BALL], WORLD_FROM_COLOR)
    first = registered(engine, CAMERA, depth).copy()
    for _ in range(5):
        np.testing.assert_array_equal(registered(engine, CAMERA, depth), first)
