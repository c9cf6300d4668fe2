"""The scan of a page: points where the depth says, in the picture's colours, and never too many of them."""

from __future__ import annotations

import numpy as np
import pytest

from client.results import point_cloud
from client.results.frame_output import Captured
from client.results.point_cloud import PointCloud
from protocol.frames import CameraModel, DepthCamera

CAMERA = CameraModel(width=160, height=120, fx=150.0, fy=150.0, cx=79.5, cy=59.5)


def places_of(cloud: PointCloud) -> np.ndarray:
    points = cloud.points()
    assert points is not None
    return points.places_m


def slope(shape: tuple[int, int] = (120, 160)) -> np.ndarray:
    """Depth that grows to the right, mm."""
    return np.broadcast_to(np.linspace(1000, 2000, shape[1]), shape).astype(np.uint16)


def test_points_lie_on_what_is_seen() -> None:
    cloud = PointCloud(CAMERA)
    turned = np.array([[0, 0, 1, 0.5], [0, 1, 0, 0], [-1, 0, 0, 2], [0, 0, 0, 1.0]])
    cloud.add(Captured(np.zeros((120, 160, 3), np.uint8), slope()), turned)
    in_camera = (places_of(cloud) - turned[:3, 3]) @ turned[:3, :3]
    u = 150 * in_camera[:, 0] / in_camera[:, 2] + 79.5
    expected_m = np.interp(u, np.arange(160), slope()[0] / 1000)
    assert np.abs(in_camera[:, 2] - expected_m).max() < 0.01  # a cell of 8 mm


def test_a_depth_camera_of_its_own() -> None:
    """Shifted by 10 cm: points are where they are, and have the colour that the other lens sees there."""
    shift = (1.0, 0, 0, 0.1, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1)
    depth = DepthCamera(width=80, height=60, fx=75.0, fy=75.0, cx=39.5, cy=29.5, color_from_depth=shift)
    camera = CameraModel(width=160, height=120, fx=150.0, fy=150.0, cx=79.5, cy=59.5, depth=depth)
    color = np.zeros((120, 160, 3), np.uint8)
    color[:, :, 0] = np.arange(160)
    cloud = PointCloud(camera)
    cloud.add(Captured(color, np.full((60, 80), 1000, np.uint16)), np.eye(4))
    places, points = places_of(cloud), cloud.points()
    assert points is not None
    red = points.colors[:, 0]
    assert np.abs(150 * places[:, 0] / places[:, 2] + 79.5 - red).max() < 1.6  # half a pixel, and a cell of 1.2 px
    assert places[:, 0].min() == pytest.approx(0.1 - 39.5 / 75, abs=0.02)


def test_what_is_not_measured_adds_nothing() -> None:
    cloud = PointCloud(CAMERA)
    color = np.zeros((120, 160, 3), np.uint8)
    for depth in (np.zeros((120, 160), np.uint16), np.full((120, 160), 65535, np.uint16), None):
        cloud.add(Captured(color, depth), np.eye(4))
    assert cloud.points() is None


def test_there_are_never_too_many(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(point_cloud, "MOST_CELLS", 1000)
    monkeypatch.setattr(point_cloud, "_PENDING", 5000)
    cloud = PointCloud(CAMERA)
    for step in range(8):
        pose = np.eye(4)
        pose[0, 3] = step
        cloud.add(Captured(np.zeros((120, 160, 3), np.uint8), slope()), pose)
    points = cloud.points()
    assert points is not None
    assert 200 < len(points.places_m) <= 1000
    assert points.cell_m > 0.008
    assert points.places_m[:, 0].max() > 6  # what the last frame alone has seen is left out


def test_what_moved_on_is_left_out() -> None:
    """A hand that is seen in one frame of many, in front of a wall."""
    cloud = PointCloud(CAMERA)
    color = np.zeros((120, 160, 3), np.uint8)
    for step in range(12):
        depth = np.full((120, 160), 2000, np.uint16)
        if step == 3:
            depth[:, :20] = 500
        cloud.add(Captured(color, depth), np.eye(4))
    assert np.mean(places_of(cloud)[:, 2] < 1) < 0.02


def test_of_a_long_run_a_part_of_the_frames_is_enough() -> None:
    """A camera that moves on by 10 cm a frame: what it sees of a wall is there to the end."""
    cloud, frames = PointCloud(CAMERA), point_cloud.ALL_FRAMES + 50
    for step in range(frames):
        pose = np.eye(4)
        pose[0, 3] = 0.1 * step
        cloud.add(Captured(np.zeros((120, 160, 3), np.uint8), np.full((120, 160), 1000, np.uint16)), pose)
    x = np.sort(places_of(cloud)[:, 0])
    assert x[0] == pytest.approx(0.1 - 79.5 / 150, abs=0.01)  # of the second frame, and a cell
    assert x[-1] > 0.1 * (frames - point_cloud.EVERY) + 0.2  # what the last one alone has seen is left out
    assert np.diff(x).max() < 0.06  # a cell and a half of the largest
