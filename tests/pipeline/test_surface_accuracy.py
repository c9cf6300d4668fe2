"""How a surface is held against the exact one, and that the volume's surface is where it is."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from client.options.source import open_source
from protocol.frames import CameraModel, RgbdFrame
from server.opencl.device import Device
from tests.bench.geometry.surface import SurfaceView, fused_views, inside_bounds, surface_accuracy
from tests.data import data_folder
from tests.scenes.analytic import look, look_at, room

CAMERA = CameraModel(width=64, height=48, fx=60.0, fy=60.0, cx=31.5, cy=23.5)
VOXEL_M = 0.02


def view(depth: object, exact: object = 1.0, inside: object = True) -> SurfaceView:
    shape = (4, 5)
    return SurfaceView(
        np.broadcast_to(depth, shape).astype(np.float32),
        np.broadcast_to(exact, shape).astype(np.float32),
        np.broadcast_to(inside, shape).astype(bool),
    )


@pytest.mark.parametrize("offset", [-0.03, 0.01])
def test_a_shifted_surface_is_off_by_its_shift(offset: float) -> None:
    found = surface_accuracy([view(1.0 + offset)], VOXEL_M)
    assert found.median_voxels == pytest.approx(abs(offset) / VOXEL_M, rel=1e-5)
    assert found.p90_voxels == pytest.approx(abs(offset) / VOXEL_M, rel=1e-5)
    assert found.bias_voxels == pytest.approx(offset / VOXEL_M, rel=1e-5)
    assert found.covered == 1


def test_views_count_by_their_pixels() -> None:
    half = np.zeros((4, 5))
    half[:2] = 1.02
    found = surface_accuracy([view(half), view(1.0), view(7.0, inside=False)], VOXEL_M)
    assert found.covered == 0.75
    assert found.median_voxels == 0  # 10 pixels off by a voxel, 20 exact
    assert found.p90_voxels == pytest.approx(1, rel=1e-5)


def test_an_empty_surface_has_no_accuracy() -> None:
    found = surface_accuracy([view(0.0)], VOXEL_M)
    assert found.covered == 0
    assert np.isinf(found.median_voxels)
    with pytest.raises(ValueError, match="inside the volume"):
        surface_accuracy([view(1.0, inside=False)], VOXEL_M)


def test_inside_is_what_lies_in_the_box() -> None:
    exact = np.full((48, 64), 1.0)
    exact[:5] = 0
    pose = np.eye(4)
    pose[:3, 3] = (10, 20, 30)
    inside = inside_bounds(CAMERA, pose, exact, (10.0, 0.0, 0.0, 11.0, 40.0, 32.0), 0.01)
    assert not inside[:5].any()
    np.testing.assert_array_equal(inside[5:], np.broadcast_to((np.arange(64) - 31.5) / 60 >= 0.01, (43, 64)))
    assert not inside_bounds(CAMERA, pose, exact, (9.0, 0.0, 0.0, 11.0, 40.0, 31.005), 0.01).any()


def frame(index: int, depth_m: np.ndarray, pose: np.ndarray) -> RgbdFrame:
    color = np.full((*depth_m.shape, 3), 128, np.uint8)
    return RgbdFrame(index, index / 30, color, np.rint(1e3 * depth_m).astype(np.uint16), pose)


def test_a_fused_room_is_where_it_is(device: Device) -> None:
    """And a room fused at poses that are 1.5 cm off is not."""
    scene = [room((-1.0, -0.8, -1.0), (1.1, 0.9, 1.3))]
    poses = [look_at((0.1 * i, -0.2, -0.6), (0.1, 0.1, 1.2)) for i in range(-2, 3)]
    truth = [look(scene, CAMERA, pose).depth_m for pose in poses]
    bounds = (-1.2, -1.2, -1.2, 1.5, 1.5, 1.5)
    frames = [frame(i, depth_m, pose) for i, (depth_m, pose) in enumerate(zip(truth, poses, strict=True))]
    shown = [(item, truth[i] if i >= 3 else None) for i, item in enumerate(frames)]
    views = fused_views(device, CAMERA, shown, bounds, VOXEL_M)
    assert len(views) == 2
    found = surface_accuracy(views, VOXEL_M)
    assert found.median_voxels < 0.01  # seen: 0.004
    assert found.covered > 0.97
    farther = [(item, None if exact is None else exact - 0.015) for item, exact in shown]
    moved = surface_accuracy(fused_views(device, CAMERA, farther, bounds, VOXEL_M), VOXEL_M)
    assert moved.bias_voxels == pytest.approx(0.75, abs=0.01)  # seen: 0.002


@pytest.mark.data
@pytest.mark.parametrize(("name", "goal_voxels"), [("mitsuba_track_clean", 0.15), ("mitsuba_track_noisy", 0.5)])
def test_public_sequences(device: Device, name: str, goal_voxels: float) -> None:
    """12 frames of those that the benchmark fuses whole."""
    source = open_source(str(data_folder(name)))
    exact = cv2.imread(str(data_folder("mitsuba_track_clean") / "depth" / "000011.png"), cv2.IMREAD_UNCHANGED) * 1e-3
    frames = ((source[i], exact if i == 11 else None) for i in range(12))
    cube = (0.0, 0.0, 0.0, 2.0, 2.0, 2.0)
    found = surface_accuracy(fused_views(device, source.camera, frames, cube, 2 / 256), 2 / 256)
    assert found.median_voxels <= goal_voxels
    assert found.covered > 0.9
