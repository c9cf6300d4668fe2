"""TSDF integration against its float64 twin on a dense grid, and its running mean against exact figures."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from protocol.frames import CameraModel
from server.opencl.engine import Engine
from server.volume.integrate import GREATEST_WEIGHT, integrate
from server.volume.volume import Volume
from tests.reference.integrate import integrate as twin
from tests.reference.integrate import integrate_color, project, voxel_centers
from tests.scenes.analytic import look, look_at, plane, room, sphere
from tests.scenes.fused_scenes import CAMERA
from tests.scenes.tolerance import relative_tolerance
from tests.scenes.volumes import dense_colors, dense_voxels, fuse, upload_measurement

BOUNDS = (-1.0, -1.0, 0.0, 1.0, 1.0, 2.4)
VOXEL_M = 0.04
SCENE = [room((-0.9, -0.9, -0.3), (0.95, 0.9, 2.2)), sphere((0.1, 0.2, 1.2), 0.4)]
FLIPS = 1e-3
"""Share of voxels whose pixel float32 rounds to its neighbour, or that lie at the end of the truncation."""

AT_LEAST = -0.5
"""Mark of a clipped pixel of another exposure than the first, see radiance_marks.clh."""

Floats = NDArray[np.float64]


class Twin:
    """The dense volume that the twin keeps."""

    def __init__(self, volume: Volume) -> None:
        shape = tuple(8 * count for count in reversed(volume.bricks))
        self.volume, self.tsdf, self.weight = volume, np.ones(shape), np.zeros(shape)

    def fuse(self, camera: CameraModel, view: Floats, depth: Floats) -> None:
        pose = self.volume.volume_from_world() @ view
        sizes = (self.volume.voxel_m, self.volume.truncation_m, GREATEST_WEIGHT)
        self.tsdf, self.weight = twin(camera, pose, depth, *sizes, self.tsdf, self.weight)


def compare(engine: Engine, expected: Twin) -> None:
    """Weights are counts, and exact; a distance rounds with the depth it is taken from, and is told in truncations."""
    volume = expected.volume
    tsdf, weight, allocated = dense_voxels(engine, volume)
    assert (expected.weight[allocated] > 0).sum() > 1000
    atol = relative_tolerance(engine.device) * 4.0 / volume.truncation_m
    same = (weight == expected.weight) & (np.abs(tsdf - expected.tsdf) < atol)
    assert (~same)[allocated].mean() < FLIPS


def sensor_depth(depth: Floats, seed: int) -> Floats:
    """Depth with holes, noise and whole millimetres, as a sensor gives it."""
    rng = np.random.default_rng(seed)
    noisy = np.rint(1000 * (depth + 0.003 * rng.normal(size=depth.shape))) / 1000
    return np.where(rng.random(depth.shape) < 0.1, 0, noisy)


CAMERAS = {
    "usual": CAMERA,
    "tiny": CameraModel(width=9, height=11, fx=8.0, fy=8.0, cx=4.0, cy=5.0),
    "crop beside the axis": CameraModel(width=97, height=71, fx=80.0, fy=78.0, cx=-110.377, cy=36.127),
    "crop beyond the axis": CameraModel(width=97, height=71, fx=80.0, fy=78.0, cx=47.313, cy=140.2),
}


@pytest.mark.parametrize("name", CAMERAS)
def test_matches_twin(engine: Engine, name: str) -> None:
    camera = CAMERAS[name]
    volume = Volume(engine, BOUNDS, VOXEL_M)
    expected = Twin(volume)
    views = [np.eye(4), look_at((0.4, -0.3, -0.2), (-0.2, 0.2, 1.4)), look_at((0.6, 0.5, 0.4), (-0.3, -0.2, 1.9))]
    for seed, view in enumerate(views):
        depth = sensor_depth(look(SCENE, camera, view).depth_m, seed).astype(np.float32).astype(np.float64)
        before = dense_voxels(engine, volume)[2]
        fuse(engine, volume, camera, view, depth)
        expected.fuse(camera, view, depth)
        new = dense_voxels(engine, volume)[2] & ~before  # the twin has bricks everywhere: forget what had none
        now = Twin(volume)
        now.fuse(camera, view, depth)
        expected.tsdf[new], expected.weight[new] = now.tsdf[new], now.weight[new]
    compare(engine, expected)


def test_color_matches_twin(engine: Engine) -> None:
    """Within the quantisation of colour: sqrt(c) in steps of 1/511 (blue 1/255), rounded in every frame."""
    volume = Volume(engine, BOUNDS, VOXEL_M)
    color, count = (
        np.zeros((*(8 * c for c in reversed(volume.bricks)), 3)),
        np.zeros([8 * c for c in volume.bricks][::-1]),
    )
    rng = np.random.default_rng(7)
    for view in (np.eye(4), look_at((0.4, -0.3, -0.2), (-0.2, 0.2, 1.4)), np.eye(4)):
        depth = look(SCENE, CAMERA, view).depth_m.astype(np.float32).astype(np.float64)
        radiance = rng.random((CAMERA.height, CAMERA.width, 3)).astype(np.float32).astype(np.float64)
        fuse(engine, volume, CAMERA, view, depth, radiance)
        pose = volume.volume_from_world() @ view
        color, count = integrate_color(CAMERA, pose, depth, radiance, VOXEL_M, volume.truncation_m, color, count)
    found, weight = dense_colors(volume)
    seen = weight > 0
    assert (weight == count + 1)[seen].mean() > 1 - FLIPS
    assert set(np.unique(weight)) == {0, 2, 3, 4}
    same = seen & (weight == count + 1)
    error = np.abs(np.sqrt(found) - np.sqrt(color))[same] / np.array([1 / 511, 1 / 511, 1 / 255])
    # A step of the root each frame; a dark mean after a bright observation loses a step of the brighter root.
    assert np.quantile(error, 0.999) < 3
    assert error.mean() < 1
    assert np.abs((np.sqrt(found) - np.sqrt(color))[same].mean(0)).max() < 5e-5  # rounding is unbiased; seen: 1e-5


@pytest.mark.parametrize(("before", "after"), [(0.25, 0.252), (0.25, 0.248), (0.01, 0.0104)])
def test_a_change_below_one_step_is_not_lost(engine: Engine, before: float, after: float) -> None:
    """A mean of 62 observations moves by 1/62 of a change, here less than half a step of the stored colour."""
    volume = Volume(engine, (-0.16, -0.16, 1.0, 0.16, 0.16, 1.32), 0.02)
    depth = np.full((CAMERA.height, CAMERA.width), 1.16)

    def look_often(value: float, times: int) -> NDArray[Any]:
        for _ in range(times):
            fuse(engine, volume, CAMERA, np.eye(4), depth, np.full((*depth.shape, 3), value))
        colors, weight = dense_colors(volume)
        return np.asarray(colors[weight == 63])

    assert abs(np.sqrt(after) - np.sqrt(before)) / 62 < 0.5 / 511
    start = look_often(before, 100)
    assert np.abs(start.mean(0) - before).max() < 0.05 * abs(after - before) + 1e-4
    moved = look_often(after, 250)
    assert np.abs(moved.mean(0) - after).max() < 0.15 * abs(after - before)


def test_colors_of_another_light_give_way(engine: Engine) -> None:
    """The first picture under the new light replaces them, a clipped one too; the shape does not count it again."""
    volume = Volume(engine, (-0.16, -0.16, 1.0, 0.16, 0.16, 1.32), 0.02)
    depth = np.full((CAMERA.height, CAMERA.width), 1.16)
    for _ in range(20):
        fuse(engine, volume, CAMERA, np.eye(4), depth, np.full((*depth.shape, 3), 0.49))
    old = dense_colors(volume)[1] > 0
    for mark, shown in ((1.0, 0.09), (AT_LEAST, 0.04)):
        volume.forget_colors(1.0)
        colors, weight = dense_colors(volume)
        assert (weight[old] == 1).all()
        assert colors[old].min() > 1.5 * shown
        voxels = dense_voxels(engine, volume)
        measurement = upload_measurement(engine, depth, np.full((*depth.shape, 3), shown))
        radiance = measurement.radiance.get()
        radiance["w"] = mark
        measurement.radiance.set(radiance)
        integrate(engine, volume, CAMERA, volume.volume_from_world(), measurement, with_shape=False)
        colors, weight = dense_colors(volume)
        assert (weight[old] == 2).all()
        assert np.abs(np.sqrt(colors[old]) - np.sqrt(shown)).max() < 1.5 / 255
        for before, after in zip(voxels, dense_voxels(engine, volume), strict=True):
            np.testing.assert_array_equal(before, after)


def test_no_color_from_outside_the_camera_s_picture(engine: Engine) -> None:
    """A rectified picture of a distorted lens has borders that no pixel filled."""
    volume = Volume(engine, (-0.16, -0.16, 1.0, 0.16, 0.16, 1.32), 0.02)
    measurement = upload_measurement(engine, np.full((CAMERA.height, CAMERA.width), 1.16))
    radiance = measurement.radiance.get()
    radiance["w"] = -1
    measurement.radiance.set(radiance)
    volume.allocate(CAMERA, volume.volume_from_world(), measurement.depth_m)
    integrate(engine, volume, CAMERA, volume.volume_from_world(), measurement)
    assert not dense_colors(volume)[1].any()
    assert dense_voxels(engine, volume)[1].any()


def test_a_bound_only_raises_a_color(engine: Engine) -> None:
    """A clipped pixel is a lower bound of the radiance."""
    volume = Volume(engine, (-0.16, -0.16, 1.0, 0.16, 0.16, 1.32), 0.02)
    depth = np.full((CAMERA.height, CAMERA.width), 1.16)

    def look(value: float, mark: float) -> NDArray[np.float64]:
        measurement = upload_measurement(engine, depth, np.full((*depth.shape, 3), value))
        radiance = measurement.radiance.get()
        radiance["w"] = mark
        measurement.radiance.set(radiance)
        volume.allocate(CAMERA, volume.volume_from_world(), measurement.depth_m)
        integrate(engine, volume, CAMERA, volume.volume_from_world(), measurement)
        colors, weight = dense_colors(volume)
        return np.asarray(np.sqrt(colors[weight > 0]))

    step = 1 / 255
    assert np.abs(look(0.36, AT_LEAST) - 0.6).max() < 1.5 * step  # nothing else is known
    assert np.abs(look(0.36, 1.0) - 0.6).max() < 2.5 * step
    assert np.abs(look(0.04, AT_LEAST) - 0.6).max() < 3.5 * step
    assert (
        np.abs(look(0.04, 1.0).mean() - np.sqrt(0.36 + (0.04 - 0.36) / 4)) < 0.1 * step
    )  # dithered: the mean is exact; seen: 0.001
    raised = look(0.81, AT_LEAST).mean()
    assert np.abs(raised - np.sqrt(0.28 + (0.81 - 0.28) / 5)) < 0.1 * step


def test_leaves_alone_what_it_does_not_see(engine: Engine) -> None:
    """Behind the camera, outside the picture, unmeasured, or deep behind the surface."""
    volume = Volume(engine, BOUNDS, VOXEL_M)
    depth = np.full((CAMERA.height, CAMERA.width), 1.2)
    depth[:, :30] = 0
    fuse(engine, volume, CAMERA, np.eye(4), depth)
    view = look_at((0.0, 0.0, 1.25), (0.05, 0.1, 0.0))  # among the bricks, looking back
    back = np.zeros_like(depth)
    back[20:50, 20:50] = 0.8
    fuse(engine, volume, CAMERA, view, back)
    _, weight, _ = dense_voxels(engine, volume)
    points = voxel_centers(weight.shape, VOXEL_M) + volume.origin_world
    rounding = 0.01  # pixels
    for pose, picture in ((np.eye(4), depth), (view, back)):
        in_camera = (points - pose[:3, 3]) @ pose[:3, :3]
        pixels = project(CAMERA, in_camera)
        u, v = np.rint(np.clip(pixels, 0, (CAMERA.width - 1, CAMERA.height - 1))).astype(int).transpose(3, 0, 1, 2)
        inside = (np.abs(pixels - (48, 35)) < np.array([48.5, 35.5]) + rounding).all(-1)
        within = in_camera[..., 2] < picture[v, u] + volume.truncation_m + 1e-4
        weight = weight - (inside & (picture[v, u] > 0) & within)
    assert weight.max() <= 0


def test_constant_depth_gives_an_exact_mean_and_a_full_weight(engine: Engine) -> None:
    volume = Volume(engine, BOUNDS, VOXEL_M)
    depth = look([plane((0, 0, 1.5), (0.3, 0.2, -1))], CAMERA, np.eye(4)).depth_m
    fuse(engine, volume, CAMERA, np.eye(4), depth)
    first, seen, _ = dense_voxels(engine, volume)
    for frame in range(2, 201):
        fuse(engine, volume, CAMERA, np.eye(4), depth)
        if frame in (2, 63, 64, 65, 200):
            tsdf, weight, _ = dense_voxels(engine, volume)
            np.testing.assert_array_equal(weight, np.minimum(frame * seen, GREATEST_WEIGHT))
            # Adding a difference of zero is exact; that of one rounding is divided by the weight.
            np.testing.assert_allclose(tsdf, first, atol=2**-23)


def test_mean_of_a_noisy_sensor(engine: Engine) -> None:
    """The plain mean until the weight is at its limit, then an exponential one, as in the twin."""
    bounds, camera = (-0.16, -0.16, 1.0, 0.16, 0.16, 1.32), CAMERAS["usual"]
    volume = Volume(engine, bounds, 0.02)
    expected = Twin(volume)
    rng = np.random.default_rng(4)
    told = []
    for frame in range(1, 101):
        depth = np.full((camera.height, camera.width), float(np.float32(1.16 + 0.01 * rng.normal())))
        told.append(depth[0, 0])
        fuse(engine, volume, camera, np.eye(4), depth)
        expected.fuse(camera, np.eye(4), depth)
        if frame in (10, 64, 100):
            tsdf, weight, _ = dense_voxels(engine, volume)
            middle = (slice(6, 10), slice(6, 10), slice(6, 10))
            assert (weight[middle] == min(frame, GREATEST_WEIGHT)).all()
            atol = 20 * relative_tolerance(engine.device)  # each of the means before it rounds, less and less
            np.testing.assert_allclose(tsdf[middle], expected.tsdf[middle], atol=atol)
            if frame <= GREATEST_WEIGHT:
                center = voxel_centers(tsdf.shape, 0.02)[8, 8, 8] + bounds[:3]
                along = np.linalg.norm(center) / center[2]
                exact = np.minimum((np.array(told) - center[2]) * along / volume.truncation_m, 1).mean()
                assert tsdf[8, 8, 8] == pytest.approx(exact, abs=atol)


def test_a_moved_wall_is_forgotten(engine: Engine) -> None:
    """After 200 frames at one place, the zero crossing follows a wall that moved by half the truncation."""
    volume = Volume(engine, (-0.16, -0.16, 1.0, 0.16, 0.16, 1.32), 0.02)
    shape = (CAMERA.height, CAMERA.width)

    def crossing() -> Any:
        column = dense_voxels(engine, volume)[0][:, 8, 8]
        index = int(np.flatnonzero((column[:-1] > 0) & (column[1:] <= 0))[0])
        return 1.01 + 0.02 * (index + column[index] / (column[index] - column[index + 1]))

    for _ in range(200):
        fuse(engine, volume, CAMERA, np.eye(4), np.full(shape, 1.14))
    assert crossing() == pytest.approx(1.14, abs=1e-3)
    for _ in range(int(3 * GREATEST_WEIGHT)):
        fuse(engine, volume, CAMERA, np.eye(4), np.full(shape, 1.18))
    assert crossing() == pytest.approx(1.18 - 0.04 * np.exp(-3), abs=2e-3)


def mean_in_16_bits(value: int, weight: int, told: float) -> int:
    """A running mean that is kept as a short, cast as KinectFusion implementations do: the next value, in 1 / 32766."""
    return int((value * weight + told * 32766) / (weight + 1))


def test_ten_thousand_frames_do_not_stall_the_mean(engine: Engine) -> None:
    """Then the wall goes 0.12 mm back, 1/500 of the truncation: that is followed, where 16 bits stay for ever.

    A share of 1/65 of that is 1/32 500 of the truncation: about a quantum of theirs, and the cast drops what is less.
    """
    volume = Volume(engine, (-0.08, -0.08, 1.0, 0.08, 0.08, 1.24), 0.015)
    pose, shape, place = volume.volume_from_world(), (CAMERA.height, CAMERA.width), (7, 5, 5)

    def told(depth_m: float, frames: int) -> tuple[float, float]:
        measurement = upload_measurement(engine, np.full(shape, depth_m))
        volume.allocate(CAMERA, pose, measurement.depth_m)
        for frame in range(frames):
            integrate(engine, volume, CAMERA, pose, measurement)
            if frame % 100 == 0:
                engine.queue.finish()
                engine.profile.begin()
        tsdf, weight, _ = dense_voxels(engine, volume)
        return float(tsdf[place]), float(weight[place])

    step = 1 / 500
    first, _ = told(1.12, 1)
    assert 0.05 < first < 0.5
    still, weight = told(1.12, 9_999)
    assert weight == GREATEST_WEIGHT
    assert still == pytest.approx(first, abs=2**-23)
    moved, _ = told(1.12 + step * volume.truncation_m, 400)
    center = voxel_centers((16, 10, 10), volume.voxel_m)[place] + volume.origin_world
    wanted = first + step * float(np.linalg.norm(center) / center[2])
    assert moved == pytest.approx(wanted, abs=0.01 * step)

    short = int(first * 32766)
    for _ in range(400):
        short = mean_in_16_bits(short, int(GREATEST_WEIGHT), wanted)
    assert abs(short / 32766 - wanted) > 0.9 * step
