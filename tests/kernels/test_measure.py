"""Measurement of the input against its float64 twin and against OpenCV's undistortion."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
import pytest
from msgspec.structs import replace
from scipy.ndimage import map_coordinates

from protocol.frames import CameraModel
from server.input.measure import GREATEST_DEPTH_M, linear_values
from server.opencl.engine import Engine
from tests.reference import measure as twin
from tests.scenes.raw_frames import PLAIN, frame_of, measured, random_frame
from tests.scenes.tolerance import relative_tolerance

BARREL = (-0.31, 0.12, 0.0011, -0.0007, -0.02)
PINCUSHION = (0.21, 0.05, -0.002, 0.0015, 0.01)
DISTORTIONS = {"none": (0.0,) * 5, "barrel": BARREL, "pincushion": PINCUSHION}
FLIPS = 5e-3
"""Share of pixels at a discontinuity that float32 may put on its other side: a rounded pixel, a mark's threshold."""


def camera_of(distortion: str, encoding: Any, **changes: Any) -> CameraModel:
    return replace(PLAIN, distortion=DISTORTIONS[distortion], color_encoding=encoding, **changes)


@pytest.mark.parametrize("encoding", ["srgb8", "linear16"])
@pytest.mark.parametrize("distortion", DISTORTIONS)
@pytest.mark.parametrize("size", [(97, 71), (64, 64), (8, 8), (129, 9)])
def test_matches_twin(engine: Engine, encoding: str, distortion: str, size: tuple[int, int]) -> None:
    camera = camera_of(distortion, encoding, width=size[0], height=size[1], cx=size[0] / 2.1, cy=size[1] / 1.9)
    frame = random_frame(camera, seed=size[0])
    radiance, depth = measured(engine, camera, frame)
    expected, expected_depth = twin.measure(camera, frame.color, frame.depth, GREATEST_DEPTH_M)
    rounding = relative_tolerance(engine.device)
    # A position in the picture rounds to a share of its width, and colour differs by up to 1 from pixel to pixel.
    atol = rounding * max(size) if camera.is_distorted else 0.0
    same = radiance[..., 3] == expected[..., 3]
    np.testing.assert_allclose(radiance[same], expected[same], rtol=rounding, atol=atol)
    same_depth = np.isclose(depth, expected_depth, rtol=rounding, atol=0)
    if camera.is_distorted:
        assert (~same).mean() < FLIPS
        assert (~same_depth).mean() < FLIPS
    else:
        assert same.all()
        assert same_depth.all()


@pytest.mark.parametrize("distortion", ["barrel", "pincushion"])
def test_undistorts_as_opencv(engine: Engine, distortion: str) -> None:
    camera = camera_of(distortion, "linear16", width=161, height=119, fx=130.0, fy=128.0, cx=79.2, cy=60.4)
    frame = random_frame(camera, seed=1)
    radiance, depth = measured(engine, camera, frame)
    matrix = np.array([[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1]])
    lens, size = np.array(camera.distortion), (camera.width, camera.height)
    map_x, map_y = cv2.initUndistortRectifyMap(matrix, lens, None, matrix, size, cv2.CV_32FC1)
    np.testing.assert_allclose(twin.distorted_pixels(camera), np.stack([map_x, map_y], -1), atol=1e-4)
    inside = radiance[..., 3] >= 0
    assert 0.5 < inside.mean() <= 1
    linear = frame.color / 65535
    for channel in range(3):  # OpenCV's map, SciPy's bilinear interpolation; OpenCV's map is float32, too
        expected = map_coordinates(linear[..., channel], [map_y, map_x], order=1, mode="nearest")
        np.testing.assert_allclose(radiance[..., channel][inside], expected[inside], atol=1e-4)
    whole = cv2.undistort(linear.astype(np.float32), matrix, lens)
    steepest = max(np.abs(np.diff(linear, axis=axis)).max() for axis in (0, 1))
    assert np.abs(radiance[..., :3] - whole)[inside].max() < 2 * steepest / 32 + 1e-4  # its maps may have 1/32 pixel
    nearest = cv2.remap(frame.depth, map_x, map_y, cv2.INTER_NEAREST, borderMode=cv2.BORDER_CONSTANT, borderValue=0)
    metres = np.where((nearest == 65535) | (nearest > 10_000), 0, nearest) * 0.001
    ties = np.abs(np.stack([map_x, map_y]) % 1 - 0.5).min(0) < 1 / 32
    differs = np.abs(depth - metres) > 1e-6
    assert differs[inside & ~ties].mean() < FLIPS
    assert not depth[~inside].any()


@pytest.mark.parametrize("distortion", ["barrel", "pincushion"])
def test_a_ramp_seen_through_the_lens_is_straight_again(engine: Engine, distortion: str) -> None:
    """Every pixel of the distorted picture shows its own ray's slope: OpenCV's inverse map says which."""
    camera = camera_of(distortion, "linear16", width=161, height=119, fx=130.0, fy=128.0, cx=79.2, cy=60.4)
    matrix = np.array([[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1]])
    pixels = np.mgrid[: camera.height, : camera.width][::-1].reshape(2, -1).T.astype(np.float64)
    rays = cv2.undistortPoints(pixels[:, None], matrix, np.array(camera.distortion))[:, 0]
    picture = np.rint(65535 * (0.5 + 0.4 * rays)).reshape(camera.height, camera.width, 2)[..., [0, 1, 1]]
    radiance, _ = measured(engine, camera, frame_of(picture, np.zeros(picture.shape[:2]), camera))
    v, u = np.mgrid[: camera.height, : camera.width]
    expected = np.stack([0.5 + 0.4 * (u - camera.cx) / camera.fx, 0.5 + 0.4 * (v - camera.cy) / camera.fy], -1)
    inside = radiance[..., 3] >= 0
    # Between two pixels the inverse map is not quite linear, and OpenCV finds it by a few iterations.
    assert np.abs(radiance[..., :2] - expected)[inside].max() < 0.4 / camera.fx * 0.1


def test_depth_that_is_none(engine: Engine) -> None:
    units = np.array([0, 1, 9_999, 10_000, 10_001, 40_000, 65_534, 65_535], np.uint16)
    depth = np.tile(units, (8, 1))
    for scale, expected in (
        (0.001, [0, 0.001, 9.999, 10.0, 0, 0, 0, 0]),
        (0.0001, [0, 0.0001, 0.9999, 1.0, 1.0001, 4.0, 6.5534, 0]),
        (1.0, [0, 1, 0, 0, 0, 0, 0, 0]),
    ):
        camera = replace(PLAIN, width=8, height=8, depth_scale_m=scale)
        _, metres = measured(engine, camera, frame_of(np.zeros((8, 8, 3)), depth, camera))
        np.testing.assert_allclose(metres, np.tile(expected, (8, 1)), rtol=1e-6)


@pytest.mark.parametrize(
    ("encoding", "codes", "marks"),
    [
        ("srgb8", [0, 4, 5, 128, 252, 253, 254, 255], [0, 0, 1, 1, 1, 1, 0, 0]),
        ("linear16", [0, 98, 99, 30_000, 64_551, 64_552, 65_000, 65_535], [0, 0, 1, 1, 1, 0, 0, 0]),
    ],
)
def test_black_and_clipped_marks(engine: Engine, encoding: Any, codes: list[int], marks: list[int]) -> None:
    """The brightest channel decides: a black channel is no black pixel, a clipped one is a clipped pixel."""
    camera = replace(PLAIN, width=8, height=8, color_encoding=encoding)
    color = np.zeros((8, 8, 3))
    for row in range(8):
        color[row, :, row % 3] = codes
    radiance, _ = measured(engine, camera, frame_of(color, np.zeros((8, 8)), camera))
    np.testing.assert_array_equal(radiance[..., 3], np.tile(marks, (8, 1)))
    np.testing.assert_array_equal(radiance[..., :3], linear_values(encoding)[color.astype(int)])


def test_no_radiance_is_made_of_a_clipped_pixel(engine: Engine) -> None:
    camera = camera_of("pincushion", "srgb8")
    color = np.full((camera.height, camera.width, 3), 100)
    color[30:34, 40:44] = 255
    radiance, _ = measured(engine, camera, frame_of(color, np.zeros(color.shape[:2]), camera))
    brighter = radiance[..., 0] > np.median(radiance[..., 0]) * 1.001
    assert brighter.sum() >= 16
    assert not radiance[brighter, 3].any()
    away = np.abs(twin.distorted_pixels(camera) - (41.5, 31.5)).max(-1) > 2.5
    assert radiance[away & (radiance[..., 3] >= 0), 3].all()


def test_extreme_distortion_is_outside_not_undefined(engine: Engine) -> None:
    camera = replace(PLAIN, distortion=(1e30, -1e30, 1e20, 1e20, 1e38))
    frame = random_frame(camera, seed=3)
    radiance, depth = measured(engine, camera, frame)
    assert np.isfinite(radiance).all()
    assert (radiance[..., 3] == -1).mean() > 0.9
    assert np.isfinite(depth).all()
