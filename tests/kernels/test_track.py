"""The tracker's kernels against their float64 twin, and recovery of known poses."""

from __future__ import annotations

import numpy as np
import pyopencl.cltypes as cl_types
import pytest
from msgspec.structs import replace

from protocol.frames import CameraModel
from server.maths.registration import angle_between, distance_between, motion_of_twist
from server.maths.rigid import inverse_rigid
from server.opencl.engine import Engine, float4, float16
from server.tracking.track import (
    ViewBuffers,
    depth_pyramid,
    finest_level,
    level_intrinsics,
    view_model,
)
from tests.reference import track as twin
from tests.scenes.analytic import Floats, look, sphere
from tests.scenes.tolerance import relative_tolerance
from tests.scenes.tracked_scene import (
    CAMERA,
    FLAT,
    SCENE,
    START,
    VOXEL_M,
    moved,
    world,
)
from tests.scenes.volumes import upload_depth, vectors


@pytest.mark.parametrize("size", [(8, 8), (97, 71), (160, 120), (33, 10)])
def test_halving_matches_twin(engine: Engine, size: tuple[int, int]) -> None:
    rng = np.random.default_rng(size[0])
    depth = np.where(
        rng.random(size[::-1]) < 0.4, rng.choice([1.0, 1.03, 1.2], size[::-1]), rng.uniform(1, 1.1, size[::-1])
    )
    depth[rng.random(depth.shape) < 0.3] = 0
    width, height = size[0] // 2, size[1] // 2
    halved = engine.workspace.array("halved", (height, width), np.float32)
    kernel = engine.kernel("track.cl", "halve_depth", ROWS=16)
    engine.launch(kernel, (width, height), width, height, size[0], upload_depth(engine, depth), 0.05, halved)
    expected = twin.halve_depth(depth.astype(np.float32).astype(np.float64), 0.05)
    assert (expected == 0).any() or size == (8, 8)
    np.testing.assert_allclose(engine.download(halved), expected, rtol=relative_tolerance(engine.device))


def test_halving_does_not_mix_surfaces(engine: Engine) -> None:
    camera = replace(CAMERA, width=640, height=480)
    depth = np.where(np.arange(640) < 321, 1.0, 2.0) * np.ones((480, 1))
    for halved in depth_pyramid(engine, camera, upload_depth(engine, depth)):
        assert set(np.unique(engine.download(halved))) == {1.0, 2.0}


@pytest.mark.parametrize("camera", [CAMERA, replace(CAMERA, width=97, height=71, cx=47.0, cy=36.0)])
def test_the_view_of_the_model_matches_twin(engine: Engine, camera: CameraModel) -> None:
    scene = world(engine, camera=camera)
    position, normal = (
        vectors(engine.download(a)).astype(np.float64) for a in (scene.model.positions, scene.model.normals)
    )
    view = view_model(engine, camera, scene.pose, scene.model, ViewBuffers(engine.workspace))
    assert finest_level(camera) == 0
    for rung, planes in enumerate(view.levels):
        got = engine.download(planes)
        expected = twin.view_model(position[..., 3] > 0, position[..., :3], normal[..., :3], scene.pose, 2**rung)
        width = expected.shape[2]
        assert got.shape[2] % 8 == 0
        assert not got[..., width:].any()
        # Positions are up to 3 m from the origin, so depth rounds as much as they do.
        np.testing.assert_allclose(got[..., :width], expected, atol=3 * relative_tolerance(engine.device))


def device_sums(
    engine: Engine,
    view: Floats,
    depth_m: Floats,
    camera: CameraModel,
    motion: Floats,
    noise: tuple[float, float, float],
) -> Floats:
    """[32] of the kernel for a view [4, h, w] and depth [h, w]."""
    _, height, width = view.shape
    pitch = -(-width // 8) * 8
    padded = np.zeros((4, height, pitch), np.float32)
    padded[..., :width] = view
    items = (pitch // 8, -(-height // 16))
    sums = engine.workspace.array("test_sums", (items[0] * items[1], 32), np.float32)
    lens = float4(camera.fx, camera.fy, camera.cx, camera.cy)
    engine.launch(
        engine.kernel("track.cl", "sum_equations", ROWS=16),
        items,
        cl_types.make_int2(width, height),  # type: ignore[attr-defined]
        pitch,
        engine.workspace.upload("test_view", padded),
        upload_depth(engine, depth_m),
        lens,
        lens,
        float16(motion),
        float16(inverse_rigid(motion)),
        *noise,
        sums,
    )
    return engine.download(sums).sum(axis=0, dtype=np.float64)


@pytest.mark.parametrize("size", [(160, 120), (97, 71), (8, 8), (40, 30)])
@pytest.mark.parametrize("motion", [np.zeros(6), np.array([0.03, -0.02, 0.01, 0.02, -0.01, 0.03])])
def test_equations_match_twin(engine: Engine, size: tuple[int, int], motion: Floats) -> None:
    camera = replace(
        CAMERA, width=size[0], height=size[1], fx=0.9 * size[0], fy=0.9 * size[0], cx=size[0] / 2.1, cy=size[1] / 1.9
    )
    truth = look(SCENE, camera, START)
    rng = np.random.default_rng(7)
    view = np.stack([truth.depth_m, *(truth.normals @ START[:3, :3]).transpose(2, 0, 1)])
    view *= rng.random(size[::-1]) > 0.1
    depth = truth.depth_m + rng.normal(0, 0.004, size[::-1])
    depth[rng.random(depth.shape) < 0.1] = 0
    depth[:, : size[0] // 4] -= 0.2  # something in front: outside the gate
    transform = motion_of_twist(motion)
    lens = (camera.fx, camera.fy, camera.cx, camera.cy)
    view, depth = view.astype(np.float32).astype(np.float64), depth.astype(np.float32).astype(np.float64)
    noise = (0.002, 20.0, 0.1)
    expected = twin.sum_equations(view, depth, lens, lens, transform, *noise)
    got = device_sums(engine, view, depth, camera, transform, noise)
    assert expected[28] > 0.1 * expected[30] > 0
    # A model point between two pixels may be associated with either; each has a share of 1 / pairs.
    *_, measured, pixel = twin.pairs(view, depth, lens, lens, transform)
    ties = (np.abs(pixel % 1 - 0.5).min(-1) < 1e-3)[measured].sum()
    diagonal = np.sqrt(np.diag(full(expected)))
    bound = (30 * relative_tolerance(engine.device) + 2 * ties / expected[30]) * np.outer(diagonal, diagonal)
    assert (np.abs(full(got) - full(expected)) <= bound).all()
    energy = np.sqrt(expected[27])
    assert (np.abs(got[21:27] - expected[21:27]) <= (1e-3 + 2 * ties / expected[30]) * diagonal * energy).all()
    np.testing.assert_allclose(got[27:30], expected[27:30], rtol=1e-3 + 2 * ties / expected[30])
    assert np.abs(got[30:] - expected[30:]).max() <= ties


def full(sums: Floats) -> Floats:
    """[6, 6] of the first 21 sums."""
    matrix = np.zeros((6, 6))
    matrix[np.triu_indices(6)] = sums[:21]
    return matrix + np.triu(matrix, 1).T


def test_the_gradient_is_the_derivative_of_the_error(engine: Engine) -> None:
    """Without the robust weight's change: a cut-off so wide that it is 1."""
    truth = look(SCENE, CAMERA, START)
    view = np.stack([truth.depth_m, *(truth.normals @ START[:3, :3]).transpose(2, 0, 1)])
    depth = np.full_like(truth.depth_m, 1.4)  # smooth, so that no association jumps to another depth
    view[0] = 1.4
    noise = (1.0, 1e6, 10.0)
    base = twin.sum_equations(view, depth, *(2 * [level_intrinsics(CAMERA, 0)]), np.eye(4), *noise)
    got = device_sums(engine, view, depth, CAMERA, np.eye(4), noise)
    np.testing.assert_allclose(got[21:27], base[21:27], atol=1e-4)
    step = 1e-3
    for axis in range(3, 6):
        shifted = motion_of_twist(step * np.eye(6)[axis])
        after = device_sums(engine, view, depth, CAMERA, shifted, noise)
        predicted = base[27] + 2 * step * base[21 + axis] + step**2 * full(base)[axis, axis]
        assert after[27] == pytest.approx(predicted, rel=2e-2)


@pytest.mark.parametrize(("turn_deg", "shift_m"), [(0.0, 0.0), (0.5, 0.01), (2.0, 0.03), (4.0, 0.06)])
@pytest.mark.parametrize("seed", range(3))
def test_a_known_motion_is_found(engine: Engine, turn_deg: float, shift_m: float, seed: int) -> None:
    scene = world(engine)
    truth = moved(np.radians(turn_deg), shift_m, seed)
    found = scene.register(look(SCENE, CAMERA, truth).depth_m, START)
    assert found is not None
    expected = scene.volume.volume_from_world() @ truth
    assert not len(found.free)
    assert found.share > 0.8
    assert distance_between(found.volume_from_camera, expected) < 0.05 * VOXEL_M
    assert angle_between(found.volume_from_camera, expected) < np.radians(0.05)


def test_a_person_in_front_does_not_move_the_camera(engine: Engine) -> None:
    scene = world(engine)
    truth = moved(np.radians(1.0), 0.02, seed=4)
    depth = look([*SCENE, sphere((-0.15, 0.0, 0.8), 0.25)], CAMERA, truth).depth_m
    covered = (depth != look(SCENE, CAMERA, truth).depth_m).mean()
    assert covered > 0.2
    found = scene.register(depth, START)
    assert found is not None
    assert distance_between(found.volume_from_camera, scene.volume.volume_from_world() @ truth) < 0.05 * VOXEL_M
    assert found.share < 1 - 0.8 * covered


@pytest.mark.parametrize("name", FLAT)
@pytest.mark.parametrize("noise_m", [0.0, 0.002])
def test_what_a_scene_does_not_fix_is_left_as_guessed(engine: Engine, name: str, noise_m: float) -> None:
    shapes, count = FLAT[name]
    scene = world(engine, shapes)
    truth = moved(np.radians(0.5), 0.01, seed=2)
    rng = np.random.default_rng(0)
    depth = look(shapes, CAMERA, truth).depth_m
    depth = np.where((depth > 0) & (depth < 3), depth + rng.normal(0, noise_m, depth.shape), 0)
    found = scene.register(depth, START)
    assert found is not None
    assert len(found.free) == count
    # Along the free directions the pose is the guess's; along the others the scene's own.
    expected = scene.volume.volume_from_world() @ truth
    change = expected @ inverse_rigid(found.volume_from_camera)
    if count == 1:
        axis = np.array([1.0, 0, 0]) if name == "two planes" else np.array([-0.6, 0, 1]) / np.sqrt(1.36)
        np.testing.assert_allclose(np.abs(found.free[0]), [0, 0, 0, *np.abs(axis)], atol=0.005)  # seen: 0.001
        assert angle_between(found.volume_from_camera, expected) < np.radians(0.02)  # seen: 0.007
        off, held = ((found.volume_from_camera - pose)[:3, 3] for pose in (expected, scene.pose))
        assert np.linalg.norm(off - (off @ axis) * axis) < 0.02 * VOXEL_M  # seen: 0.004
        assert abs(held @ axis) < 1e-3 < abs((expected - scene.pose)[:3, 3] @ axis)
    if name == "sphere":
        center = np.array([0.1, 0.2, 1.3, 1]) - [*scene.volume.origin_world, 0]
        np.testing.assert_allclose((change @ center)[:3], center[:3], atol=0.1 * VOXEL_M)
    if name == "plane":
        normal = np.array([0.2, 0.1, -1.0]) / np.linalg.norm([0.2, 0.1, -1.0])
        np.testing.assert_allclose(change[:3, :3] @ normal, normal, atol=np.radians(0.01))  # seen: 0.0025
        across = np.cross(normal, [1, 0, 0])
        assert abs((found.volume_from_camera - scene.pose)[:3, 3] @ across) < 1e-5  # seen: 1e-6


def test_pictures_that_do_not_meet(engine: Engine) -> None:
    scene = world(engine)
    for depth in (0.0, 0.02, 9.0):
        assert scene.register(np.full((120, 160), depth), START) is None
    assert (
        scene.register(look(SCENE, CAMERA, START).depth_m, START @ motion_of_twist(np.array([0, np.pi, 0, 0, 0, 0])))
        is None
    )


def test_the_same_input_gives_the_same_bits(engine: Engine) -> None:
    scene = world(engine)
    depth = look(SCENE, CAMERA, moved(0.02, 0.02, 1)).depth_m
    results = [scene.register(depth, START) for _ in range(3)]
    assert results[0] is not None
    for other in results[1:]:
        assert other is not None
        np.testing.assert_array_equal(results[0].volume_from_camera, other.volume_from_camera)


def test_levels_start_where_noise_is_averaged_away() -> None:
    for width, level in ((8, 0), (160, 0), (320, 1), (640, 2), (1280, 3)):
        assert finest_level(replace(CAMERA, width=width)) == level
    fx, _, cx, _ = level_intrinsics(CAMERA, 2)
    x = 0.3
    assert fx * x + cx == pytest.approx((CAMERA.fx * x + CAMERA.cx - 1.5) / 4)  # pixel 0 is the mean of pixels 0 to 3
