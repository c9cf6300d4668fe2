"""Pixels of a frame on the host: where they lie in the room, and points of the room in the picture."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from protocol.frames import CameraModel
from server.room.frame_view import FrameView
from tests.scenes.analytic import look_at

CAMERA = CameraModel(width=16, height=12, fx=20.0, fy=10.0, cx=7.0, cy=5.0)
POSE = look_at((1.0, -0.5, 0.2), (0.0, 0.3, 2.0))


def view(depth_m: NDArray[np.float32], scan_m: float = 0.0) -> FrameView:
    """A frame with this sensor's depth, and a scan at one depth; 0: none."""
    v, u = np.mgrid[:12, :16]
    rays = np.stack([(u - 7) / 20, (v - 5) / 10, np.ones((12, 16))], axis=-1)
    positions = scan_m * rays @ POSE[:3, :3].T + POSE[:3, 3]
    return FrameView(
        index=0,
        camera=CAMERA,
        room_from_camera=POSE,
        up=np.array([0.0, -1.0, 0.0]),
        depth_m=depth_m,
        positions=positions.astype(np.float32),
        normals=np.zeros((12, 16, 3), np.float32),
        is_surface=np.full((12, 16), scan_m > 0),
    )


def plain(depth_m: float = 2.0) -> NDArray[np.float32]:
    return np.full((12, 16), depth_m, np.float32)


def depth_of(point: NDArray[np.float64] | None) -> float:
    assert point is not None
    return float((point - POSE[:3, 3]) @ POSE[:3, 2])


@pytest.mark.parametrize("pixel", [(0.0, 0.0), (15.0, 11.0), (3.3, 8.7)])
def test_a_pixel_and_back(pixel: tuple[float, float]) -> None:
    frame = view(plain())
    point = frame.in_pixel(*pixel)
    assert point is not None
    np.testing.assert_allclose(frame.project(point), (*pixel, 2.0), atol=1e-6)


def test_points_behind_the_camera_have_no_pixel() -> None:
    assert np.isnan(view(plain()).project(POSE[:3, 3] - POSE[:3, 2])).all()


def test_a_hole_takes_the_nearest_depth_then_that_of_the_scan() -> None:
    depth_m = np.zeros((12, 16), np.float32)
    depth_m[5, 9], depth_m[4, 5] = 3.0, 4.0
    assert depth_of(view(depth_m).in_pixel(8, 5)) == pytest.approx(3.0)
    assert depth_of(view(depth_m, scan_m=1.5).in_pixel(2, 10)) == pytest.approx(1.5, abs=1e-6)
    assert view(depth_m).in_pixel(2, 10) is None
    assert view(depth_m).in_pixel(16, 5) is None


def test_noise_is_averaged_and_edges_are_kept() -> None:
    depth_m = plain()
    depth_m[5, 8] = 2.015
    depth_m[:, 9:] = 1.0
    assert depth_of(view(depth_m).in_pixel(8, 5)) == pytest.approx(2.0, abs=1e-6)
    assert depth_of(view(depth_m).in_pixel(9, 5)) == pytest.approx(1.0, abs=1e-6)
