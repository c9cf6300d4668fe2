"""Exposure: the comparison kernel against its float64 twin, and the estimate over frames."""

from __future__ import annotations

import math

import numpy as np
import pyopencl.cltypes as cl_types
import pytest
from numpy.typing import NDArray

from protocol.frames import CameraModel, RgbdFrame
from server.input.measure import Measurement
from server.opencl.buffers import DeviceBuffer
from server.opencl.engine import Engine
from server.tracking import exposure as stage
from server.tracking.exposure import (
    DEAD_BAND,
    ExposureTracking,
    Samples,
    compare_exposure,
    followed,
    locate_exposure,
    scene_radiance,
)
from server.volume.volume import Volume
from tests.reference import exposure as twin
from tests.scenes.analytic import look, look_at, room, sphere
from tests.scenes.tolerance import relative_tolerance
from tests.scenes.volumes import dense_colors, dense_voxels, fuse, upload_depth, upload_measurement, vectors

Floats = NDArray[np.float64]

CAMERA = CameraModel(width=97, height=71, fx=80.0, fy=78.0, cx=47.313, cy=36.127)
BOUNDS = (-1.0, -1.0, 0.0, 1.0, 1.0, 2.4)
VOXEL_M = 0.04
SCENE = [room((-0.9, -0.9, -0.3), (0.95, 0.9, 2.2)), sphere((0.1, 0.2, 1.2), 0.4)]
VIEWS = [np.eye(4), look_at((0.2, -0.15, -0.1), (0.0, 0.1, 1.4)), look_at((0.35, 0.1, 0.05), (0.0, 0.1, 1.4))]
FLIPS = 0.01
"""Share of samples at a threshold that float32 may put on its other side."""


def painted(view: Floats) -> tuple[Floats, Floats]:
    """Depth [h, w] and radiance [h, w, 3] of the scene, with a paint that is of one brightness over a few pixels."""
    truth = look(SCENE, CAMERA, view)
    x, y, z = np.moveaxis(truth.points, -1, 0)
    paint = 0.3 + 0.25 * np.sin(3 * x + 1) * np.cos(4 * y + z)
    return truth.depth_m, np.stack([paint, 0.8 * paint, 0.6 * paint], axis=-1)


def picture(engine: Engine, view: Floats, factor: float, seed: int = 0) -> tuple[Measurement, Floats, Floats]:
    """A view at another exposure, on the device and on the host, with unusable pixels and holes."""
    rng = np.random.default_rng(seed)
    depth, color = painted(view)
    depth = np.where(rng.random(depth.shape) < 0.05, 0, depth).astype(np.float32).astype(np.float64)
    usable = np.where(rng.random(depth.shape) < 0.01, 0.0, 1.0)
    radiance = np.concatenate([factor * color, usable[..., None]], -1).astype(np.float32)
    device = engine.workspace.upload("other_radiance", radiance.view(cl_types.float4)[..., 0])
    return Measurement(device, upload_depth(engine, depth)), radiance.astype(np.float64), depth


@pytest.fixture
def volume(engine: Engine) -> Volume:
    made = Volume(engine, BOUNDS, VOXEL_M)
    for view in VIEWS[:2]:
        fuse(engine, made, CAMERA, view, *painted(view))
    return made


def dense(engine: Engine, volume: Volume) -> twin.DenseVolume:
    tsdf, weight, _ = dense_voxels(engine, volume)
    color, stored = dense_colors(volume)
    observations = np.maximum(stored - 1, 0)
    return twin.DenseVolume(VOXEL_M, tsdf.astype(np.float64), weight.astype(np.float64), color, observations)


@pytest.mark.parametrize("most", [300, 2304])
def test_samples_match_the_twin(engine: Engine, volume: Volume, most: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(stage, "_MOST_SAMPLES", most)
    measurement, radiance, depth = picture(engine, VIEWS[2], 0.7)
    pose = volume.volume_from_world() @ VIEWS[2]
    read, download = [], engine.download
    monkeypatch.setattr(engine, "download", lambda array: read.append(download(array)) or read[-1])
    compare_exposure(engine, CAMERA, measurement, volume, pose)
    stride = math.ceil(math.sqrt(CAMERA.width * CAMERA.height / most))
    found = vectors(read[0])
    expected = twin.compare_exposure(
        CAMERA, pose, radiance, depth, dense(engine, volume), volume.truncation_m, min(2.0, volume.frames), stride
    )
    assert not found[..., 3].any()
    used = expected[..., 0] > 0
    assert used.mean() > 0.25
    assert (used != (found[..., 0] > 0)).mean() < FLIPS
    both = used & (found[..., 0] > 0)
    rounding = relative_tolerance(engine.device)
    np.testing.assert_allclose(found[both][:, 0], expected[both][:, 0], rtol=rounding)
    # Where along the ray the surface lies rounds with its depth, in voxels; the paint changes by half of itself in one.
    np.testing.assert_allclose(found[both][:, 1:3], expected[both][:, 1:], rtol=20 * rounding)


def test_what_is_compared_says_the_exposure(engine: Engine, volume: Volume) -> None:
    """Within 1 % (paint and voxels), for every exposure of the picture; the volume itself is not part of it."""
    pose = volume.volume_from_world() @ VIEWS[2]
    for factor in (0.25, 1.0, 1.5):
        measurement, *_ = picture(engine, VIEWS[2], factor)
        found = locate_exposure(compare_exposure(engine, CAMERA, measurement, volume, pose), 0.0)
        assert found is not None
        assert abs(found.value - math.log(factor)) < 0.002  # seen: 0.0003
        assert 0 < found.std < 0.002  # seen: 0.0004


def test_what_was_not_there_is_not_compared(engine: Engine, volume: Volume) -> None:
    """A bright hand before the camera, half of the picture, is no surface that the volume has."""
    pose = volume.volume_from_world() @ VIEWS[2]
    _, radiance, depth = picture(engine, VIEWS[2], 1.0)
    depth[:, : CAMERA.width // 2] = 0.3
    radiance[:, : CAMERA.width // 2, :3] = 0.9
    measurement = upload_measurement(engine, depth, radiance[..., :3])
    samples = compare_exposure(engine, CAMERA, measurement, volume, pose)
    found = locate_exposure(samples, 0.0)
    assert found is not None
    assert abs(found.value) < 0.001  # seen: 0.0001
    assert samples.seen.max() < 0.7


def test_colors_of_another_light_are_not_compared(engine: Engine, volume: Volume) -> None:
    pose = volume.volume_from_world() @ VIEWS[2]
    measurement, *_ = picture(engine, VIEWS[2], 1.0)
    assert len(compare_exposure(engine, CAMERA, measurement, volume, pose)) > 100
    volume.forget_colors(1.0)
    assert len(compare_exposure(engine, CAMERA, measurement, volume, pose)) == 0


def test_nothing_is_said_of_places_that_were_never_seen(engine: Engine, volume: Volume) -> None:
    away = look_at((0.0, 0.0, 1.0), (0.0, 0.0, -1.0))
    measurement, *_ = picture(engine, away, 2.0)
    samples = compare_exposure(engine, CAMERA, measurement, volume, volume.volume_from_world() @ away)
    assert len(samples) < 100
    assert locate_exposure(samples, 0.3) is None


@pytest.mark.parametrize("exposure", [0.3, 2.0])
def test_scene_radiance_matches_the_twin(engine: Engine, exposure: float) -> None:
    rng = np.random.default_rng(3)
    radiance = np.concatenate([rng.random((71, 97, 3)), rng.integers(-1, 2, (71, 97, 1))], -1).astype(np.float32)
    radiance[::3, ..., :3] *= np.where(radiance[::3, ..., 3:] == 0, 0.001, 1)  # black ones
    device = engine.workspace.upload("other_radiance", radiance.view(cl_types.float4)[..., 0])
    found = vectors(
        engine.download(scene_radiance(engine, device, exposure, DeviceBuffer(engine.workspace, cl_types.float4)))
    )
    expected = twin.scale_radiance(radiance.astype(np.float64), 1 / exposure)
    np.testing.assert_array_equal(found[..., 3], expected[..., 3])
    np.testing.assert_allclose(found, expected, rtol=relative_tolerance(engine.device))
    assert set(np.unique(found[..., 3])) == {-1, -0.5, 0, 1}


def test_exposure_1_is_the_very_picture(engine: Engine) -> None:
    measurement, *_ = picture(engine, VIEWS[0], 1.0)
    unused = DeviceBuffer(engine.workspace, cl_types.float4)
    assert scene_radiance(engine, measurement.radiance, 1.0, unused) is measurement.radiance


# ---- over frames, without a device -------------------------------------------------------------------------------


class Wandering:
    """Surface points that a camera sees in turn, and the running means that a volume keeps of them."""

    def __init__(self, noise: float, texture: float, points: int = 600) -> None:
        self.random = np.random.default_rng(0)
        self.noise = float(np.hypot(noise, texture))
        self.points = points
        self.true = self.random.uniform(0.05, 0.8, 4 * points)
        self.kept, self.observations = self.true.copy(), np.ones(4 * points)
        self.log = 0.0

    def frame(self, number: int, exposure: float, darker: float = 1.0) -> float:
        """The logarithm after one more picture; `darker`: what every third part of the scene is seen at."""
        here = np.arange(self.points) + number * self.points // 40 % (3 * self.points)
        seen = self.true[here] * exposure * np.exp(self.random.normal(0, self.noise, self.points))
        seen[here // 40 % 3 == 0] *= darker
        groups = np.arange(self.points) // 40
        found = locate_exposure(Samples(seen, self.kept[here], self.observations[here], groups), self.log)
        assert found is not None
        self.log = followed(self.log, found)
        self.observations[here] = np.minimum(self.observations[here] + 1, 63)
        self.kept[here] += (seen / math.exp(self.log) - self.kept[here]) / self.observations[here]
        return self.log


def test_a_constant_exposure_stays_constant_to_the_last_bit() -> None:
    """A thousand frames of noise of 3 % and texture of 4 %."""
    scene = Wandering(0.03, 0.04)
    assert [scene.frame(number, 1.0) for number in range(1, 1001)] == [0.0] * 1000


def test_a_shadow_over_a_third_is_hardly_an_exposure() -> None:
    """It comes at once, stays until the volume has half learnt it, and goes: 6 %, where a mean would say 23."""
    scene = Wandering(0.03, 0.04)
    logs = [scene.frame(number, 1.0, darker=0.5 if 10 <= number < 100 else 1.0) for number in range(1, 200)]
    assert max(map(abs, logs)) < 0.1
    assert abs(logs[12]) < DEAD_BAND


def test_a_walking_exposure_is_followed_without_drift() -> None:
    """Over 900 frames within the dead band and what the volume's own means were late by."""
    scene = Wandering(0.02, 0.03)
    true = [2 ** math.sin(2 * math.pi * number / 90) for number in range(900)]
    errors = np.array([scene.frame(number, true[number]) - math.log(true[number]) for number in range(1, 900)])
    assert np.abs(errors).max() < 0.05
    assert np.abs(errors[-90:].mean()) < 0.02


def test_noise_does_not_modulate_a_followed_exposure() -> None:
    """After a step the factor stands, a dead band away at the most."""
    scene = Wandering(0.03, 0.04)
    logs = [scene.frame(number, 0.6) for number in range(1, 60)]
    assert np.abs(np.array(logs) - math.log(0.6)).max() < 2 * DEAD_BAND
    assert np.std(logs[20:]) < 0.003


# ---- what frames say ---------------------------------------------------------------------------------------------


def frame_of(exposure: float | None) -> RgbdFrame:
    size = (CAMERA.height, CAMERA.width)
    return RgbdFrame(0, 0.0, np.zeros((*size, 3), np.uint8), np.zeros(size, np.uint16), np.eye(4), exposure)


class Said:
    """Frames whose pictures show nothing, so that only what they say counts."""

    def __init__(self, engine: Engine, mode: str = "auto") -> None:
        self.volume = Volume(engine, BOUNDS, VOXEL_M)
        self.measurement = upload_measurement(engine, np.zeros((CAMERA.height, CAMERA.width)))
        self.tracking = ExposureTracking(engine, CAMERA, mode)  # type: ignore[arg-type]

    def say(self, exposure: float | None) -> tuple[float, tuple[str, ...]]:
        return self.tracking.update(frame_of(exposure), self.measurement, self.volume, np.eye(4))


def test_given_exposures_are_relative_to_the_first(engine: Engine) -> None:
    said = Said(engine)
    assert [said.say(x)[0] for x in (0.02, 0.02, 0.04, 0.01)] == [1.0, 1.0, 2.0, 0.5]


def test_a_frame_that_does_not_say_keeps_the_last(engine: Engine) -> None:
    said = Said(engine)
    assert [said.say(x) for x in (0.02, 0.03, None, 0.04)] == [(1.0, ()), (1.5, ()), (1.5, ()), (2.0, ())]


def test_what_is_said_late_is_relative_to_what_was_found(engine: Engine) -> None:
    said = Said(engine)
    assert [said.say(x)[0] for x in (None, None, 8.0, 4.0)] == [1.0, 1.0, 1.0, 0.5]


def test_constant_is_constant_whatever_is_said(engine: Engine) -> None:
    said = Said(engine, "constant")
    assert [said.say(x) for x in (0.02, 0.04, float("nan"))] == [(1.0, ())] * 3


@pytest.mark.parametrize("bad", [0.0, -0.02, float("nan"), float("inf"), -float("inf"), 0.02 * 65, 0.02 / 65, 5e-324])
@pytest.mark.parametrize("at", [0, 2])
def test_what_cannot_be_an_exposure_is_told_and_left(engine: Engine, bad: float, at: int) -> None:
    said = Said(engine)
    values = [0.02, 0.02, 0.02, 0.02]
    values[at] = bad
    answers = [said.say(x) for x in values]
    if at == 0 and math.isfinite(bad) and bad > 0:
        return  # nothing to compare it with
    assert [factor for factor, _ in answers] == [1.0] * 4
    (note,) = answers[at][1]
    assert "exposure" in note
    assert "\n" not in note
    assert not any(notes for number, (_, notes) in enumerate(answers) if number != at)
