"""The static pipeline (thesis 4.1) on scenes known in closed form; the triangulation where Open3D is installed."""

from __future__ import annotations

import sys
import warnings
from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from types import ModuleType

import cv2
import msgspec
import numpy as np
import pytest
import trimesh

from client.cli import run_command
from client.errors import RunError, SourceError
from client.options.source import open_source
from client.static_model.cloud_normals import (
    GREATEST_RADIUS,
    LEAST_RADIUS,
    NORMAL_ERROR_RAD,
    chosen_radius_m,
    fit_planes,
    oriented_outwards,
    smooth,
    spacing_m,
)
from client.static_model.model import StaticModel, model_of_fusion
from client.static_model.point_cloud import CloudFusion, PointCloud, depth_noise_m, pixel_rays, usable_pixels
from protocol.frames import IDENTITY, CameraModel, DepthCamera, RgbdFrame
from tests.data import data_folder
from tests.scenes.analytic import Shape, look, look_at, plane, room, sphere

CAMERA = CameraModel(width=160, height=120, fx=130.0, fy=130.0, cx=79.5, cy=59.5, depth_scale_m=0.0001)
CELL_M = 0.02
BALL_CENTER, BALL_RADIUS = np.array([0.1, 0.25, 1.6]), 0.35
FLOOR_Y = 0.6
SCENE = (plane((0, FLOOR_Y, 0), (0, -1, 0)), sphere(BALL_CENTER, BALL_RADIUS), room((-2, -2, -1), (2, 2, 3)))
POSES = [look_at((x, -0.4, z), (0.05, 0.3, 1.6)) for x, z in ((-1.2, 0.2), (-0.4, 0.0), (0.4, 0.0), (1.3, 0.3))]


@pytest.fixture
def open3d() -> ModuleType:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # what its own dependencies warn of
        return pytest.importorskip("open3d", reason="Open3D is not installed (make install-bench)")


def shot(index: int, pose: np.ndarray, scene: tuple[Shape, ...] = SCENE, noise: float = 0.0) -> RgbdFrame:
    """An exact picture; `noise` is in standard deviations of the sensor's."""
    depth_m = look(scene, CAMERA, pose).depth_m
    depth_m = depth_m + noise * depth_noise_m(depth_m) * np.random.default_rng(index).normal(size=depth_m.shape)
    depth = np.where(depth_m > 0, np.rint(depth_m / CAMERA.depth_scale_m).clip(1, 65535), 0).astype(np.uint16)
    color = np.zeros((*depth.shape, 3), np.uint8) + np.array([188, 120, 10], np.uint8)
    return RgbdFrame(index, index / 30, color, depth, pose)


def fused(frames: list[RgbdFrame], camera: CameraModel = CAMERA) -> CloudFusion:
    fusion = CloudFusion(camera, CELL_M)
    for frame in frames:
        fusion.add(frame)
    return fusion


@lru_cache(maxsize=2)
def scene_cloud(noise: float) -> PointCloud:
    return fused([shot(i, pose, noise=noise) for i, pose in enumerate(POSES)]).cloud()


def distance_and_normal(points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """To the nearest surface of SCENE, and that surface's normal towards the room."""
    offset = points - BALL_CENTER
    length = np.linalg.norm(offset, axis=1)
    walls = np.stack([points[:, 0] + 2, 2 - points[:, 0], points[:, 1] + 2, points[:, 2] + 1, 3 - points[:, 2]])
    candidates = np.vstack([FLOOR_Y - points[:, 1], length - BALL_RADIUS, walls])
    normals = np.array([[1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, 0, 1], [0, 0, -1]], float)
    nearest = np.abs(candidates).argmin(axis=0)
    table = np.vstack([[0, -1, 0], [0, 0, 0], normals])[nearest]
    return np.abs(candidates).min(axis=0), np.where((nearest == 1)[:, None], offset / length[:, None], table)


def angle_deg(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return np.degrees(np.arccos((a * b).sum(axis=1).clip(-1, 1)))


def test_points_lie_on_the_surface_one_to_a_cell() -> None:
    cloud = scene_cloud(0.0)
    distance, _ = distance_and_normal(cloud.points)
    assert len(cloud.points) > 5000
    assert np.median(distance) < 1e-4
    # On a curve the mean of a cell sags by up to cell^2 / (8 radius); a corner's by a quarter of its diagonal.
    on_ball = np.abs(np.linalg.norm(cloud.points - BALL_CENTER, axis=1) - BALL_RADIUS) < 0.01
    assert distance[on_ball].max() < 3 * CELL_M**2 / (8 * BALL_RADIUS)
    assert distance.max() < CELL_M * np.sqrt(3) / 4
    cells = np.floor((cloud.points - cloud.points[0]) / CELL_M)
    assert len(np.unique(cells, axis=0)) > 0.6 * len(cells)  # another origin, so borders differ
    assert np.abs(cloud.colors - [0.5029, 0.1878, 0.00304]).max() < 1e-3


def test_measurements_weigh_by_the_sensors_noise() -> None:
    wall = (plane((0, 0, 3), (0, 0, -1)),)
    near, far = look_at((0, 0, 2), (0, 0, 3)), look_at((0, 0, 0), (0, 0, 3))
    displaced = shot(1, far, wall)
    displaced = replace(displaced, depth=displaced.depth + np.uint16(40))  # 4 mm too far
    z = fused([shot(0, near, wall), displaced]).cloud()
    both = z.points[z.frames == 2]
    w_near, w_far = depth_noise_m(np.array([1.0, 3.004])) ** -2
    pixels_near, pixels_far = 1.0, 1 / 9  # a cell is seen by nine times as many pixels from a third of the distance
    expected = 3 + 0.004 * w_far * pixels_far / (w_near * pixels_near + w_far * pixels_far)
    assert len(both) > 100
    assert np.median(both[:, 2]) == pytest.approx(expected, abs=2e-5)


def test_viewing_directions_are_the_cameras_mean() -> None:
    left, right = look_at((-1, 0, 0), (0, 0, 2)), look_at((1, 0, 0), (0, 0, 2))
    wall = (plane((0, 0, 2), (0, 0, -1)),)
    cloud = fused([shot(0, left, wall), shot(1, right, wall)]).cloud()
    middle = np.linalg.norm(cloud.points - [0, 0, 2], axis=1) < 0.1
    assert middle.sum() > 20
    assert angle_deg(cloud.towards_camera[middle], np.array([[0, 0, -1.0]])).max() < 3
    only_right = cloud.points[:, 0] < cloud.points[:, 0].min() + 0.1  # it looks to the left
    expected = np.array([1.0, 0, 0]) - cloud.points[only_right]
    expected /= np.linalg.norm(expected, axis=1, keepdims=True)
    assert angle_deg(cloud.towards_camera[only_right], expected).max() < 1


def test_depth_of_a_lens_of_its_own_gets_the_colour_of_the_same_place() -> None:
    """The depth lens stands 6 cm to the right of the colour lens and looks at a wall that is red for x > 0."""
    depth_lens = DepthCamera(
        width=120, height=90, fx=90.0, fy=90.0, cx=59.5, cy=44.5, color_from_depth=(1, 0, 0, 0.06, *IDENTITY[4:])
    )
    camera = msgspec.structs.replace(CAMERA, depth=depth_lens)
    pose = look_at((0.3, 0, 0), (0.3, 0, 2))
    color = np.zeros((120, 160, 3), np.uint8)
    x = 0.3 + (np.arange(160) - CAMERA.cx) / CAMERA.fx * 2
    color[:, x > 0, 0] = 255
    frame = RgbdFrame(0, 0.0, color, np.full((90, 120), 20_000, np.uint16), pose)
    cloud = fused([frame], camera).cloud()
    # The depth lens sees x from -0.97 to 1.69, the colour lens less: what has no colour is left out.
    low, high = (0.3 + side * 80 / 130 * 2 for side in (-1, 1))
    assert low < cloud.points[:, 0].min() < low + 0.05
    assert high - 0.05 < cloud.points[:, 0].max() < high
    clear = np.abs(cloud.points[:, 0]) > 0.03
    np.testing.assert_allclose(cloud.colors[clear, 0], cloud.points[clear, 0] > 0, atol=1e-6)
    expected = pose[:3, 3] + [0.06, 0, 0] - cloud.points
    expected /= np.linalg.norm(expected, axis=1, keepdims=True)
    assert angle_deg(cloud.towards_camera, expected).max() < 0.1


def test_edges_of_depth_are_left_out() -> None:
    depth = np.full((9, 12), 1.0)
    depth[:, 6:] = 1.5
    depth[4, 2] = 0
    depth[0, 0] = 5.5
    usable = usable_pixels(depth)
    expected = np.ones((9, 12), bool)
    expected[:, 5:7] = False
    expected[4, 2] = expected[0, 0] = False
    np.testing.assert_array_equal(usable, expected)
    assert not usable_pixels(np.zeros((4, 4))).any()


def test_a_pixel_is_on_the_ray_that_the_lens_bends_to_it() -> None:
    bent = CameraModel(
        width=64, height=48, fx=50.0, fy=51.0, cx=31.0, cy=24.0, distortion=(-0.2, 0.05, 0.001, -0.002, 0.01)
    )
    rays = pixel_rays(bent)[::8, ::8].reshape(-1, 3)
    matrix = np.array([[50.0, 0, 31], [0, 51, 24], [0, 0, 1]])
    pixels, _ = cv2.projectPoints(rays, np.zeros(3), np.zeros(3), matrix, np.array(bent.distortion))
    v, u = np.mgrid[:48:8, :64:8]
    assert np.abs(pixels.reshape(-1, 2) - np.stack([u.ravel(), v.ravel()], axis=1)).max() < 0.02


def test_what_one_of_many_frames_saw_is_left_out() -> None:
    wall = (plane((0, 0, 2), (0, 0, -1)),)
    still = look_at((0, 0, 0), (0, 0, 2))
    frames = [shot(i, still, wall) for i in range(10)]
    flying = frames[3].depth.copy()
    flying[50:60, 70:80] = 15000
    frames[3] = replace(frames[3], depth=flying)
    assert np.abs(fused(frames).cloud().points[:, 2] - 2).max() < 1e-3
    assert fused(frames[:9]).cloud().points[:, 2].min() < 1.6, "few frames are taken as they are"


def test_order_of_frames_does_not_matter() -> None:
    frames = [shot(i, POSES[i % 4], noise=1.0) for i in range(4)]
    ours, theirs = fused(frames), CloudFusion(CAMERA, CELL_M)
    theirs._origin = ours._origin
    for frame in frames[::-1]:
        theirs.add(frame)
    np.testing.assert_allclose(ours.cloud().points, theirs.cloud().points, atol=1e-12)


@pytest.mark.parametrize("noise", [0.0, 1.0])
def test_normals_are_the_surfaces(noise: float) -> None:
    """Degrees, away from edges by two radii of the smoothing."""
    surface, _ = oriented_outwards(smooth(scene_cloud(noise)))
    distance, normal = distance_and_normal(surface.cloud.points)
    off = angle_deg(surface.normals, normal)
    assert np.median(off) < (0.1, 1.5)[int(noise)]
    assert np.percentile(off, 75) < (1.0, 4.0)[int(noise)]
    assert np.median(distance) < (1e-4, 0.003)[int(noise)]


def test_smoothing_takes_noise_away() -> None:
    cloud = scene_cloud(1.0)
    before, after = distance_and_normal(cloud.points)[0], distance_and_normal(smooth(cloud).cloud.points)[0]
    assert np.median(after) < 0.4 * np.median(before)


def test_the_viewing_direction_mends_every_wrong_normal() -> None:
    smoothed = smooth(scene_cloud(1.0))
    flipped, away = oriented_outwards(smoothed)
    _, truth = distance_and_normal(smoothed.cloud.points)
    wrong_before, wrong_after = (angle_deg(s.normals, truth) > 90 for s in (smoothed, flipped))
    assert wrong_before.mean() > 0.2
    assert wrong_after.mean() < 0.002
    np.testing.assert_array_equal(flipped.normals[away], -smoothed.normals[away])
    np.testing.assert_array_equal(flipped.normals[~away], smoothed.normals[~away])


def flat_cloud(noise_m: float, count: int = 4000, at: tuple[float, float, float] = (0, 0, 0)) -> PointCloud:
    """Random points of a tilted square metre."""
    random = np.random.default_rng(2)
    points = np.column_stack([random.uniform(-0.5, 0.5, (count, 2)), noise_m * random.normal(size=count)])
    tilt = look_at((0, 0, 0), (0.3, -0.4, 0.8))[:3, :3]
    ones = np.ones(count)
    return PointCloud(
        points @ tilt.T + at, np.zeros((count, 3)), np.tile(-tilt[:, 2], (count, 1)), ones, ones.astype(int)
    )


def test_the_radius_is_the_one_that_gives_the_wanted_error() -> None:
    cloud = flat_cloud(0.004)
    spacing = spacing_m(cloud.points)
    assert spacing == pytest.approx(1 / np.sqrt(4000), rel=0.1)
    radius = chosen_radius_m(spacing, 0.004)
    assert LEAST_RADIUS * spacing < radius < GREATEST_RADIUS * spacing
    found, _ = oriented_outwards(fit_planes(cloud, radius))
    inner = np.abs(cloud.points).max(axis=1) < 0.35
    tilt = cloud.towards_camera[0]
    off = np.radians(angle_deg(found.normals[inner[: len(found.normals)]], tilt[None]))
    # The Gaussian weights use about half of the disc's points, the error is of two slopes.
    assert 0.5 * NORMAL_ERROR_RAD < np.sqrt((off**2).mean()) < 4 * NORMAL_ERROR_RAD


def test_the_radius_stays_between_its_limits() -> None:
    assert chosen_radius_m(0.01, 0.0) == pytest.approx(LEAST_RADIUS * 0.01)
    assert chosen_radius_m(0.01, 1.0) == pytest.approx(GREATEST_RADIUS * 0.01)
    assert chosen_radius_m(0.01, 0.004) > chosen_radius_m(0.01, 0.003)


def test_a_world_far_from_its_origin_loses_nothing() -> None:
    here, there = (smooth(flat_cloud(0.002, at=at), 0.06) for at in ((0, 0, 0), (10_000, -20_000, 5_000)))
    assert np.median(angle_deg(here.normals, there.normals) % 180) < 1e-3


@pytest.mark.parametrize(
    ("frames", "told"),
    [
        ([replace(shot(0, POSES[0]), depth=np.zeros((120, 160), np.uint16))], "there is nothing to model"),
        ([replace(shot(7, POSES[0]), world_from_camera=None)], "frame 7 has no pose"),
        ([shot(0, POSES[0]), shot(1, look_at((1e6, 0, 0), (1e6, 0, 2)), (plane((0, 0, 2), (0, 0, -1)),))], "apart"),
    ],
)
def test_bad_input_is_one_clear_line(frames: list[RgbdFrame], told: str) -> None:
    with pytest.raises(SourceError, match=told) as caught:
        fused(frames).cloud()
    assert "\n" not in str(caught.value)


def test_too_few_points_are_told() -> None:
    cloud = flat_cloud(0.0, count=12)
    with pytest.raises(RunError, match="12 points are too few"):
        smooth(cloud)
    with pytest.raises(RunError, match="too far apart"):
        smooth(flat_cloud(0.0, count=100), radius_m=1e-4)


def test_what_is_not_installed_is_named_before_the_frames(monkeypatch, capsys, tmp_path: Path) -> None:
    monkeypatch.setitem(sys.modules, "open3d", None)
    assert run_command(["model", "synthetic:table", "--out", str(tmp_path / "model.ply")]) == 1
    assert "needs Open3D, which is not installed: .venv/bin/pip install" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("arguments", "told"),
    [
        (["synthetic:table", "--out", "model.obj"], ".ply or .glb"),
        (["synthetic:table", "--out", "model.ply", "--voxel", "-1"], "--voxel -1"),
        (["synthetic:table", "--out", "model.ply", "--frames", "5:2"], "--frames 5:2"),
    ],
)
@pytest.mark.usefixtures("open3d")
def test_wrong_options_are_told(arguments: list[str], told: str, capsys) -> None:
    assert run_command(["model", *arguments]) == 2
    assert told in capsys.readouterr().err


@lru_cache(maxsize=1)
def scene_model() -> StaticModel:
    fusion = fused([shot(i, pose, noise=1.0) for i, pose in enumerate(POSES)])
    return model_of_fusion(fusion, CELL_M, np.diag([1.0, -1.0, -1.0]))


@pytest.mark.usefixtures("open3d")
def test_the_mesh_is_the_scene() -> None:
    mesh = scene_model().mesh
    distance, normal = distance_and_normal(mesh.vertices.astype(np.float64))
    assert np.median(distance) < 0.003
    corners = mesh.vertices[mesh.triangles].astype(np.float64)
    faces = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    assert ((faces * normal[mesh.triangles[:, 0]]).sum(axis=1) > 0).mean() > 0.98
    assert np.median(angle_deg(mesh.normals.astype(np.float64), normal)) < 1.5
    assert np.abs(mesh.colors.astype(int) - [188, 120, 10]).max() <= 1
    seen = look(SCENE, CAMERA, POSES[1])
    solid = trimesh.Trimesh(mesh.vertices, mesh.triangles, process=False)
    assert solid.area > 0.5 * seen.is_continuous.sum() * (2 / 130) ** 2  # pixels at about two metres


@pytest.mark.usefixtures("open3d")
def test_equal_frames_give_the_same_model() -> None:
    first = scene_model().mesh
    scene_model.cache_clear()
    second = scene_model().mesh
    np.testing.assert_array_equal(first.vertices, second.vertices)
    np.testing.assert_array_equal(first.triangles, second.triangles)


@pytest.mark.usefixtures("open3d")
def test_specks_alone_are_no_model() -> None:
    frame = shot(0, look_at((0, 0, 0), (0, 0, 1.5)), (plane((0, 0, 1.5), (0, 0, -1)),))
    small = np.zeros_like(frame.depth)
    small[50:60, 70:80] = frame.depth[50:60, 70:80]
    with pytest.raises(RunError, match="specks"):
        model_of_fusion(fused([replace(frame, depth=small)]), CELL_M, np.eye(3))


@pytest.mark.usefixtures("open3d")
def test_the_command_writes_what_viewers_open(tmp_path: Path, capsys) -> None:
    for name in ("model.ply", "model.glb"):
        command = ["model", "synthetic:table?size=160x120", "--frames", "0:3", "--voxel", "0.02", "--out"]
        assert run_command([*command, str(tmp_path / name)]) == 0
        assert "normals flipped" in capsys.readouterr().out
        read = trimesh.load(tmp_path / name, force="mesh")
        assert len(read.faces) > 500
        assert np.all(read.extents > 0.2)


@pytest.mark.data
@pytest.mark.parametrize(("name", "median_deg"), [("mitsuba_track_clean", 0.1), ("mitsuba_track_noisy", 0.8)])
def test_rendered_rooms(open3d, name: str, median_deg: float) -> None:
    """Normals of the points against the room's own triangles."""
    source = open_source(str(data_folder(name)))
    truth = open3d.t.io.read_triangle_mesh(str(data_folder("mitsuba_room/truth/room.ply")))
    scene = open3d.t.geometry.RaycastingScene()
    scene.add_triangles(truth)
    fusion = CloudFusion(source.camera, 0.01)
    for i in range(0, 100, 9):
        fusion.add(source[i])
    smoothed = smooth(fusion.cloud())
    surface, away = oriented_outwards(smoothed)
    found = scene.compute_closest_points(open3d.core.Tensor(surface.cloud.points.astype(np.float32)))
    normal = found["primitive_normals"].numpy().astype(np.float64)
    normal *= np.where((normal * surface.cloud.towards_camera).sum(axis=1) < 0, -1, 1)[:, None]
    assert np.median(angle_deg(surface.normals, normal)) < median_deg
    assert (angle_deg(smoothed.normals, normal) > 90).mean() > 0.2
    assert (angle_deg(surface.normals, normal) > 90).mean() < 0.005
    assert away.mean() > 0.2
