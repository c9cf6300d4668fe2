"""The predicted surface against its float64 twin, and against scenes whose depth is known in closed form."""

from __future__ import annotations

import numpy as np
import pytest
from msgspec.structs import replace
from numpy.typing import NDArray

from protocol.frames import CameraModel
from server.opencl.engine import Engine
from server.volume import raycast
from server.volume.raycast import GREATEST_DEPTH_M
from server.volume.volume import Volume
from tests.reference.integrate import voxel_centers
from tests.reference.raycast import raycast as twin
from tests.reference.raycast import trilinear
from tests.scenes.analytic import Shape, Truth, box, look, look_at, pixel_rays, plane, quantised
from tests.scenes.fused_scenes import (
    BALL,
    BALL_CENTER,
    BALL_RADIUS,
    BOUNDS,
    CAMERA,
    SCENES,
    Floats,
)
from tests.scenes.volumes import cast, dense_voxels, fill, fuse

SMALL = CameraModel(width=51, height=37, fx=41.0, fy=42.0, cx=24.313, cy=18.627)
VOXEL_M = 0.05

Bools = NDArray[np.bool_]


def volume_of(engine: Engine, voxel_m: float = VOXEL_M) -> Volume:
    return Volume(engine, BOUNDS, voxel_m)


def fused(engine: Engine, scene: list[Shape], views: list[Floats], step_m: float = 0.0) -> Volume:
    volume = volume_of(engine)
    for view in views:
        depth = look(scene, CAMERA, view).depth_m
        fuse(engine, volume, CAMERA, view, quantised(depth, step_m) if step_m else depth)
    return volume


def dense(engine: Engine, volume: Volume) -> tuple[Floats, Floats]:
    tsdf, weight, _ = dense_voxels(engine, volume)
    return tsdf.astype(np.float64), weight.astype(np.float64)


def degrees_between(a: Floats, b: Floats) -> Floats:
    return np.degrees(2 * np.arcsin(np.clip(np.linalg.norm(a - b, axis=-1) / 2, 0, 1)))


# ---- against the twin --------------------------------------------------------------------------------------------


def compare_with_twin(engine: Engine, volume: Volume, camera: CameraModel, view: Floats, smooth: Bools) -> None:
    """smooth: pixels away from silhouettes.

    The kernel finds the crossing by one or two Newton steps instead of bisection. Where the field is smooth that is
    exact to the field's curvature. Three of four rays are found between those around them, which are at most two
    voxels apart, where these have seen one smooth surface. Beside silhouettes fused views disagree, the field bends
    within a voxel, and rays graze solid voxels that the kernel may miss. On the border of what was seen it
    extrapolates by up to 1.5 voxels.
    """
    hit, depth, normal = cast(engine, volume, camera, view)
    pose = volume.volume_from_world() @ view
    tsdf, weight = dense(engine, volume)
    expected, positions, normals = twin(camera, pose, volume.voxel_m, GREATEST_DEPTH_M, tsdf, weight)
    expected_depth = (positions - pose[:3, 3]) @ pose[:3, 2]
    assert (hit & expected).mean() > 0.25
    assert (expected & ~hit).mean() < 5e-3
    assert (hit & ~expected).mean() < 15e-3
    both = hit & expected & smooth
    error = np.abs(depth - expected_depth) / volume.voxel_m
    turned = degrees_between(normal, normals)
    walked, between = both.copy(), both.copy()
    walked[1::2] = walked[:, 1::2] = between[::2, ::2] = False
    assert np.median(error[walked]) < 1e-4  # seen: 2e-6
    assert np.percentile(error[walked], 99) < 0.01  # seen: 0.0016
    assert np.median(turned[walked]) < 0.04  # seen: 0.027, where rays are two voxels apart
    assert np.percentile(turned[walked], 99) < 0.6  # seen: 0.22
    assert np.median(error[between]) < 0.01  # seen: 0.004
    assert np.percentile(error[between], 99) < 0.1  # seen: 0.02 of true distances, 0.09 of fused depth
    assert np.percentile(turned[between], 99) < 3  # seen: 0.6, and 2.1
    np.testing.assert_allclose(np.linalg.norm(normal[hit], axis=-1), 1, atol=1e-6)


@pytest.mark.parametrize("name", SCENES)
def test_matches_twin(engine: Engine, name: str) -> None:
    scene, views, new = SCENES[name]
    smooth = look(scene, SMALL, new).is_continuous
    compare_with_twin(engine, fused(engine, scene, views), SMALL, new, smooth)


@pytest.mark.parametrize("size", [(8, 8), (64, 12), (33, 50)])
def test_matches_twin_on_an_exact_field(engine: Engine, size: tuple[int, int]) -> None:
    """A true signed distance, seen everywhere, pictures of any size."""
    camera = replace(CAMERA, width=size[0], height=size[1], fx=40.0, fy=40.0, cx=size[0] / 2.1, cy=size[1] / 1.9)
    volume = volume_of(engine)
    shape = tuple(8 * count for count in reversed(volume.bricks))
    centers = voxel_centers(shape, VOXEL_M) + volume.origin_world
    walls = np.minimum(centers - (-1.3, -1.0, -1.3), (1.4, 1.1, 1.6) - centers).min(-1)
    distance = np.minimum(walls, np.linalg.norm(centers - BALL_CENTER, axis=-1) - BALL_RADIUS)
    fill(engine, volume, np.clip(distance / volume.truncation_m, -1, 1), np.ones(shape))
    new = look_at((0.7, -0.5, -0.8), (0.0, 0.1, 0.3))
    truth = look(BALL, camera, new)
    compare_with_twin(engine, volume, camera, new, truth.is_continuous | (min(size) < 10))
    hit, depth, normal = cast(engine, volume, camera, new)
    assert hit.all()
    inner = truth.is_continuous
    if inner.any():  # trilinear interpolation of a ball of 9 voxels' radius is off by 1 / (8 * 9) voxel
        assert np.abs(depth - truth.depth_m)[inner].max() / VOXEL_M < 0.15
        assert np.median(degrees_between(normal, truth.normals)[inner]) < 0.2


# ---- against closed forms ----------------------------------------------------------------------------------------


def seen_inside(engine: Engine, volume: Volume, truth: Truth) -> Bools:
    """[h, w] whether the volume saw all voxels within one and a half of the true surface point: not its border."""
    tsdf, weight = dense(engine, volume)
    points = (truth.points - volume.origin_world) / volume.voxel_m
    seen = truth.is_continuous.copy()
    for offset in np.ndindex(2, 2, 2):
        seen &= trilinear(tsdf, weight, points + 2 * np.array(offset) - 1)[1]
    return seen


@pytest.mark.parametrize("step_m", [0.0, 0.001])
@pytest.mark.parametrize("name", SCENES)
def test_surface_is_where_it_is(engine: Engine, name: str, step_m: float) -> None:
    scene, views, new = SCENES[name]
    volume = fused(engine, scene, views, step_m)
    truth = look(scene, CAMERA, new)
    hit, depth, normal = cast(engine, volume, CAMERA, new)
    inner = seen_inside(engine, volume, truth)
    assert inner.mean() > 0.2
    assert hit[inner].all()
    error = np.abs(depth - truth.depth_m)[inner] / VOXEL_M
    assert np.median(error) < 0.03  # seen: 0.009
    assert np.percentile(error, 99) < 0.5
    assert np.median(degrees_between(normal, truth.normals)[inner]) < 0.6  # seen: 0.32
    facing = (normal * (pixel_rays(CAMERA) @ new[:3, :3].T)).sum(-1)
    assert (facing[hit] < 0).all()


def test_flat_surfaces_are_flat(engine: Engine) -> None:
    """Exact depth of planes gives exact planes: the slope between pixels is not made into steps."""
    scene, views, new = SCENES["tilted planes"]
    volume = fused(engine, scene, views)
    truth = look(scene, CAMERA, new)
    hit, depth, normal = cast(engine, volume, CAMERA, new)
    inner = seen_inside(engine, volume, truth) & hit
    assert np.percentile(np.abs(depth - truth.depth_m)[inner], 95) / VOXEL_M < 0.05
    assert np.percentile(degrees_between(normal, truth.normals)[inner], 90) < 0.5


def test_a_ball_seen_all_around_keeps_its_size(engine: Engine) -> None:
    """Rays that graze a ball measure the wall behind it, and pull its surface in: by less than half a voxel here."""
    views = [
        look_at((0.1 + 1.05 * np.sin(a), -0.2 + 0.3 * np.cos(3 * a), 0.3 - 1.05 * np.cos(a)), BALL_CENTER)
        for a in np.linspace(0, 2 * np.pi, 8, endpoint=False)
    ]
    volume = fused(engine, BALL, views)
    new = look_at((0.75, -0.5, -0.7), (0.0, 0.15, 0.3))
    truth = look(BALL, CAMERA, new)
    hit, depth, _ = cast(engine, volume, CAMERA, new)
    on_ball = np.abs(np.linalg.norm(truth.points - BALL_CENTER, axis=-1) - BALL_RADIUS) < 1e-6
    inner = seen_inside(engine, volume, truth) & on_ball
    assert inner.sum() > 1000
    assert hit[inner].all()
    assert np.abs(np.median((depth - truth.depth_m)[inner])) / VOXEL_M < 0.5


@pytest.mark.parametrize("flipped", [False, True])
@pytest.mark.parametrize("axis", [0, 1, 2])
def test_looking_exactly_along_an_axis(engine: Engine, axis: int, flipped: bool) -> None:
    """Rays with zeros in their direction, from a camera on bricks' boundaries, inside and outside the volume."""
    camera = replace(CAMERA, width=96, height=72, cx=48.0, cy=36.0)
    view = np.eye(4)
    view[:3, :3] = np.roll(np.eye(3), axis, axis=0)
    if flipped:
        view[:3, :3] = view[:3, :3] @ np.diag([-1.0, 1.0, -1.0])
    volume = Volume(engine, (-1.6, -1.6, -1.6, 1.6, 1.6, 1.6), VOXEL_M)
    wall = [plane(view[:3, 2], -view[:3, 2])]
    truth = look(wall, camera, view)
    fuse(engine, volume, camera, view, truth.depth_m)
    for back_m in (0.0, 0.4, 1.6, 3.0):
        moved = view.copy()
        moved[:3, 3] = -back_m * view[:3, 2]
        hit, depth, normal = cast(engine, volume, camera, moved)
        expected = look(wall, camera, moved)
        inner = seen_inside(engine, volume, expected)
        assert inner[36].sum() > 15
        assert inner[:, 48].sum() > 10
        assert hit[inner].all()
        np.testing.assert_allclose(depth[inner], 1 + back_m, atol=0.01 * VOXEL_M)
        np.testing.assert_allclose(normal[inner], np.broadcast_to(-view[:3, 2], normal[inner].shape), atol=1e-3)


def test_no_back_faces(engine: Engine) -> None:
    wall = [plane((0, 0, 0.5), (0.2, 0.1, -1))]
    volume = fused(engine, wall, [look_at((0, 0, -1), (0, 0, 1))])
    for eye in ((0.0, 0.0, 1.2), (0.3, -0.2, 0.65), (0.0, 0.0, 3.0)):
        hit, _, _ = cast(engine, volume, CAMERA, look_at(eye, (0.0, 0.0, 0.4)))
        assert not hit.any()
    assert cast(engine, volume, CAMERA, look_at((0, 0, -1), (0, 0, 1)))[0].mean() > 0.5


def test_from_behind_a_wall_the_far_wall_is_seen(engine: Engine) -> None:
    far, near = plane((0, 0, 1.4), (0.1, 0, -1)), plane((0, 0, -0.4), (0, 0, 1))
    volume = fused(engine, [far], [look_at((0, 0, 0), (0, 0, 1))])
    fuse(
        engine,
        volume,
        CAMERA,
        look_at((0, 0, 0.6), (0, 0, -1)),
        look([near], CAMERA, look_at((0, 0, 0.6), (0, 0, -1))).depth_m,
    )
    new = look_at((0, 0, -1.0), (0, 0, 1))
    hit, depth, _ = cast(engine, volume, CAMERA, new)
    truth = look([far], CAMERA, new)
    inner = seen_inside(engine, volume, truth)
    assert inner.sum() > 300
    assert hit[inner].all()
    np.testing.assert_allclose(depth[inner], truth.depth_m[inner], atol=0.1 * VOXEL_M)


def test_behind_a_silhouette_the_wall_is_seen(engine: Engine) -> None:
    """Rays that pass a ball within a voxel go on to the wall: no ring of holes around it."""
    scene, views, new = SCENES["ball in a room"]
    volume = fused(engine, scene, views)
    truth = look(scene, CAMERA, new)
    hit, _, _ = cast(engine, volume, CAMERA, new)
    tsdf, weight = dense(engine, volume)
    seen = trilinear(tsdf, weight, (truth.points - volume.origin_world) / VOXEL_M)[1]
    ring = seen & ~truth.is_continuous
    assert ring.sum() > 300
    assert (~hit[ring]).mean() < 0.01


@pytest.mark.parametrize("items", [1, 7, 4096])
def test_the_rest_is_the_same_however_it_is_shared(engine: Engine, items: int, monkeypatch: pytest.MonkeyPatch) -> None:
    scene, views, new = SCENES["ball in a room"]
    volume = fused(engine, scene, views)
    as_usual = cast(engine, volume, CAMERA, new)
    cast(engine, volume, CAMERA, views[0])  # in the same memory: what is left out would show another view
    monkeypatch.setattr(raycast, "_REST_ITEMS", items)
    for found, expected in zip(cast(engine, volume, CAMERA, new), as_usual, strict=True):
        np.testing.assert_array_equal(found, expected)


@pytest.mark.parametrize("far_m", [1e4, -1e4])
def test_a_scene_far_from_the_origin_is_the_same(engine: Engine, far_m: float) -> None:
    scene, views, new = SCENES["tilted planes"]
    near = cast(engine, fused(engine, scene, views), CAMERA, new)
    offset = np.array([far_m, 0.25 * far_m, -far_m])
    bounds = tuple(float(value) for value in np.array(BOUNDS) + np.tile(offset, 2))
    volume = Volume(engine, bounds, VOXEL_M)  # type: ignore[arg-type]

    def moved(view: Floats) -> Floats:
        result = view.copy()
        result[:3, 3] += offset
        return result

    for view in views:
        fuse(engine, volume, CAMERA, moved(view), look(scene, CAMERA, view).depth_m)
    hit, depth, normal = cast(engine, volume, CAMERA, moved(new))
    assert (hit != near[0]).mean() < 1e-3  # voxels on the border of what was seen
    both = hit & near[0]
    assert np.percentile(np.abs(depth - near[1])[both], 99) < 1e-5
    assert np.percentile(np.abs(normal - near[2])[both], 99) < 1e-3


def test_an_empty_volume_shows_nothing(engine: Engine) -> None:
    volume = volume_of(engine)
    for eye in ((0, 0, 0), (0, 0, -4), (9e3, 0, 0)):
        hit, _, _ = cast(engine, volume, CAMERA, look_at(eye, (0.01, 0.0, 0.02)))
        assert not hit.any()


def test_what_was_not_seen_is_no_surface(engine: Engine) -> None:
    """Negative voxels of weight 0; and where only free space was seen, as a surface would need solid voxels."""
    volume = volume_of(engine)
    shape = tuple(8 * count for count in reversed(volume.bricks))
    z = voxel_centers(shape, VOXEL_M)[..., 2] + volume.origin_world[2]
    tsdf = np.clip((0.5 - z) / volume.truncation_m, -1, 1)
    view = look_at((0, 0, -1), (0, 0, 1))
    for weight in (np.zeros(shape), (z < 0.5) * 1.0):
        fill(engine, volume, tsdf, weight)
        assert not cast(engine, volume, CAMERA, view)[0].any()
    fill(engine, volume, tsdf, np.ones(shape))
    assert cast(engine, volume, CAMERA, view)[0].mean() > 0.9


def test_surface_beyond_the_greatest_depth_is_not_seen(engine: Engine) -> None:
    camera = replace(CAMERA, fx=400.0, fy=400.0)
    volume = fused(engine, [plane((0, 0, 0.5), (0, 0, -1))], [look_at((0, 0, -1), (0, 0, 1))])
    for distance, seen in ((9.5, True), (10.5 + 8 * VOXEL_M, False)):
        hit, _, _ = cast(engine, volume, camera, look_at((0, 0, 0.5 - distance), (0, 0, 1)))
        assert hit[30:40, 40:50].all() == seen
        assert hit.any() == seen


def test_a_camera_too_far_away_for_float32_ends(engine: Engine) -> None:
    """400 000 voxels away a step of 0.01 voxel no longer moves a ray: it must not walk for ever."""
    voxel_m = 2e-5
    side = 128 * voxel_m
    volume = Volume(engine, (-side / 2, -side / 2, 8.0, side / 2, side / 2, 8.0 + side), voxel_m)
    camera = replace(CAMERA, fx=80 * 8 / side, fy=80 * 8 / side)
    fuse(engine, volume, camera, np.eye(4), np.full((camera.height, camera.width), 8 + side / 2))
    assert volume.allocated_bricks > 0
    assert not cast(engine, volume, camera, np.eye(4))[0].any()


def test_what_is_narrow_is_not_missed_between_rays(engine: Engine) -> None:
    """A post two voxels wide, nearer and nearer: three of four rays begin at what those beside them have seen."""
    camera = replace(CAMERA, width=96, height=72, cx=47.3, cy=35.6)
    post = [plane((0, 0, 1.2), (0, 0, -1)), box((-0.05, -1.5, 0.85), (0.05, 1.5, 0.95))]
    volume = fused(engine, post, [look_at((0.3 * np.sin(a), 0.1, 0.0), (0, 0, 1)) for a in np.linspace(-1, 1, 5)])
    for distance_m in (-0.2, 0.0, 0.3):
        view = look_at((0.05, 0.0, distance_m), (0.0, 0.0, 2.0))
        truth = look(post, camera, view)
        hit, depth, _ = cast(engine, volume, camera, view)
        inner = seen_inside(engine, volume, truth)
        on_post = inner & (truth.points[..., 2] < 1.1)
        assert on_post.sum() > 50
        assert hit[inner].all()
        assert (np.abs(depth - truth.depth_m)[on_post] < 2 * VOXEL_M).all()  # the wall is at least four behind
