"""The three ways to a camera's pose, through the geometry half: how exact, how steady, how far off on public data."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

from client.options.source import open_source
from client.sources.volume import default_volume, default_voxel
from server.client_session import ClientSession
from server.geometry.geometry import Geometry
from server.maths.registration import angle_between, distance_between, motion_of_twist
from server.opencl.engine import Engine
from tests.bench.geometry.trajectory import ate_rmse_m, position_errors_m, track_source
from tests.data import data_folder
from tests.scenes.analytic import Floats, plane
from tests.scenes.rooms import BOUNDS, CAMERA, VOXEL_M, frame_at, view_at, wishes

Open = Callable[[str], Geometry]


@pytest.fixture
def open_geometry(engine: Engine) -> Open:
    return lambda poses: Geometry(engine, CAMERA, wishes(poses))


def test_track_follows_without_poses(open_geometry: Open) -> None:
    """From the first pose; what the client names later is not looked at."""
    geometry, truth, found = open_geometry("track"), [], []
    for index in range(60):
        view = view_at(index)
        result = geometry.scan(frame_at(view, index, given=view if index == 0 else np.eye(4)))
        assert (result.tracking, result.notes) == ("tracked", ())
        truth.append(view)
        found.append(result.world_from_camera)
    np.testing.assert_array_equal(found[0], truth[0])
    assert sum(distance_between(a, b) for a, b in pairwise(truth)) > 0.8
    assert ate_rmse_m(found, truth) < 0.15 * VOXEL_M  # seen: 0.128; a view of the model is kept over many frames
    assert max(angle_between(a, b) for a, b in zip(found, truth, strict=True)) < np.radians(0.1)  # seen: 0.072


def test_tracking_starts_from_the_identity_without_any_pose(open_geometry: Open) -> None:
    geometry = open_geometry("track")
    first = geometry.scan(frame_at(view_at(0)))
    np.testing.assert_array_equal(first.world_from_camera, np.eye(4))
    assert first.tracking == "tracked"


def test_sensor_noise_does_not_lead_away(open_geometry: Open) -> None:
    geometry, truth, found = open_geometry("track"), [], []
    for index in range(40):
        truth.append(view_at(index))
        frame = frame_at(truth[-1], index, noise_m=0.006, given=truth[0])
        found.append(geometry.scan(frame).world_from_camera)
    assert ate_rmse_m(found, truth) < 0.3 * VOXEL_M  # seen: 0.226, of noise of 6 mm, which is 0.3 voxel


@pytest.mark.parametrize(("noise_m", "bound_m"), [(0.0, 2.5e-7), (0.003, 6e-4)])
def test_a_camera_that_stands_still_does_not_drift(open_geometry: Open, noise_m: float, bound_m: float) -> None:
    """Once the volume has settled. Seen: 1.2e-7 m (a float32 at 1.5 m ends at 1e-7) and 4.3e-4 m; 6e-9 m in means over
    the same noise, 60 frames apart: less than 1e-7 m a frame."""
    geometry = open_geometry("track")
    view = view_at(5)
    frames = [frame_at(view, index, noise_m=noise_m, given=view) for index in range(20)]
    found = [geometry.scan(frames[index % 20]).world_from_camera for index in range(150)]
    assert max(distance_between(pose, found[40]) for pose in found[40:]) < bound_m
    assert distance_between(np.mean(found[-50:], axis=0), np.mean(found[40:90], axis=0)) < 5e-6


def test_given_poses_are_taken_as_they_are(open_geometry: Open) -> None:
    geometry = open_geometry("given")
    for index, step in enumerate((0, 30, 2)):
        wrong = view_at(step) @ motion_of_twist(np.array([0.05, 0, 0, 0.05, 0, 0]))
        result = geometry.scan(frame_at(view_at(step), index, given=wrong))
        assert result.tracking == "given"
        np.testing.assert_allclose(result.world_from_camera, wrong, atol=1e-12)


def test_refine_corrects_a_client_that_drifts(open_geometry: Open) -> None:
    geometry, drift, truth, given, found = open_geometry("refine"), np.eye(4), [], [], []
    for index in range(40):
        truth.append(view_at(index))
        given.append(truth[-1] @ drift)
        found.append(geometry.scan(frame_at(truth[-1], index, given=given[-1])).world_from_camera)
        drift = drift @ motion_of_twist(np.array([0.001, -0.0005, 0.0008, 0.002, 0.0005, -0.001]))
    assert ate_rmse_m(given, truth) > 0.04
    assert ate_rmse_m(found, truth) < 0.15 * VOXEL_M  # seen: 0.121, as without any pose of the client


def test_refine_follows_motion_that_tracking_alone_cannot(open_geometry: Open) -> None:
    """40 cm and 17 degrees between two frames: the client's motion says where to begin."""
    views = [view_at(step) for step in (0, 2, 4, 24, 26)]
    outcomes = {}
    for mode in ("refine", "track"):
        geometry = open_geometry(mode)
        results = [geometry.scan(frame_at(view, index, given=view)) for index, view in enumerate(views)]
        outcomes[mode] = distance_between(results[-1].world_from_camera, views[-1])
        if mode == "refine":
            assert [result.tracking for result in results] == ["given", *["tracked"] * 4]
    assert outcomes["refine"] < 0.15 * VOXEL_M  # seen: 0.082


def test_refine_takes_the_clients_motion_where_the_depth_does_not_fit(open_geometry: Open) -> None:
    geometry = open_geometry("refine")
    geometry.scan(frame_at(view_at(0), 0, given=view_at(0)))
    covered = replace(frame_at(view_at(3), 1, given=view_at(3)), depth=np.zeros((120, 160), np.uint16))
    result = geometry.scan(covered)
    assert result.tracking == "given"
    assert any("the client's motion is not corrected" in note for note in result.notes)
    np.testing.assert_allclose(result.world_from_camera, view_at(3), atol=1e-9)
    assert geometry.scan(frame_at(view_at(4), 2, given=view_at(4))).tracking == "tracked"


@pytest.mark.parametrize(("mode", "words"), [("track", "left as it was"), ("refine", "taken from the client's pose")])
def test_what_a_plane_does_not_fix_is_said(open_geometry: Open, mode: str, words: str) -> None:
    geometry, wall = open_geometry(mode), [plane((0, 0, 1.5), (0, 0, -1))]
    start, end = np.eye(4), motion_of_twist(np.array([0, 0, 0.01, 0.01, 0.004, 0.008]))
    geometry.scan(frame_at(start, 0, scene=wall, given=start))
    result = geometry.scan(frame_at(end, 1, scene=wall, given=end))
    note = next(note for note in result.notes if "does not fix" in note)
    assert "motion along (" in note
    assert "turning about (0.00, 0.00, 1.00)" in note
    assert words in note
    expected = end if mode == "refine" else motion_of_twist(np.array([0, 0, 0, 0, 0, 0.008]))
    assert distance_between(result.world_from_camera, expected) < 5e-5  # seen: 9e-6
    assert angle_between(result.world_from_camera, expected) < 1e-6  # seen: 1e-7


def test_the_pipeline_lights_a_tracked_stream(engine: Engine) -> None:
    """A tracked stream gives the light and the pictures that the same stream with true poses gives."""
    results = {}
    for mode in ("given", "track"):
        pipeline = ClientSession(engine.device, CAMERA, wishes(mode))
        for index in range(4):
            result = pipeline.process(frame_at(view_at(index), index, given=view_at(index)))
        results[mode] = result
        pipeline.close()
    directions = [np.array(results[mode].light.dominant_direction) for mode in results]
    assert np.degrees(np.arccos(np.clip(directions[0] @ directions[1], -1, 1))) < 0.5  # seen: 0.19
    assert results["track"].tracking == "tracked"


def test_ate_aligns_the_first_pose_only() -> None:
    rng = np.random.default_rng(0)
    truth: list[Floats] = [motion_of_twist(rng.normal(size=6)) for _ in range(10)]
    elsewhere = motion_of_twist(rng.normal(size=6))
    assert ate_rmse_m([elsewhere @ pose for pose in truth], truth) == pytest.approx(0, abs=1e-12)
    off = [pose.copy() for pose in truth]
    off[4][:3, 3] += (0.03, 0.0, 0.04)
    assert ate_rmse_m(off, truth) == pytest.approx(0.05 / np.sqrt(10))
    assert position_errors_m(off, truth).argmax() == 4
    with pytest.raises(ValueError, match="3 estimated poses for 10"):
        ate_rmse_m(off[:3], truth)


def test_track_source_says_every_frames_pose_and_state(engine: Engine) -> None:
    class Source:
        camera = CAMERA

        def __getitem__(self, index: int) -> object:
            return frame_at(view_at(index), index, given=view_at(index))

    told: list[tuple[int, int]] = []
    track = track_source(engine, Source(), range(2, 6), VOXEL_M, BOUNDS, "track", lambda *n: told.append(n))  # type: ignore[arg-type]
    assert track.statuses == ["tracked"] * 4
    assert told == [(n, 4) for n in (1, 2, 3, 4)]
    assert ate_rmse_m(track.poses, [view_at(index) for index in range(2, 6)]) < 0.06 * VOXEL_M  # seen: 0.039
    assert all(ms > 0 for ms in track.track_ms[1:])


@pytest.mark.data
@pytest.mark.parametrize(
    ("name", "frames", "bound_m"),
    [
        ("mitsuba_track_clean", 50, 0.00017),
        ("mitsuba_track_noisy", 50, 0.0012),
        ("rgbd_livingroom1_synth", 40, 0.0075),
        ("rgbd_7scenes_redkitchen", 40, 0.0087),
    ],
)
def test_trajectories_of_public_data(engine: Engine, name: str, frames: int, bound_m: float) -> None:
    """Seen: 0.10, 1.09, 5.2 and 6.2 mm. The two rooms of real size drift with the frames; nothing closes loops. The
    cubes do not: 100 frames of them are 0.10 and 1.13 mm off. With one iteration a level, the clean one is 0.18."""
    source = open_source(str(data_folder(name)))
    is_cube = name.startswith("mitsuba")
    volume = (0.0, 0.0, 0.1, 2.0, 2.0, 2.1) if is_cube else default_volume(source, range(len(source)))
    voxel_m = 2 / 256 if is_cube else default_voxel(volume)
    track = track_source(engine, source, range(frames), voxel_m, volume, "track")
    assert track.statuses == ["tracked"] * frames
    truth = [source[index].world_from_camera for index in range(frames)]
    assert ate_rmse_m(track.poses, truth) < bound_m  # type: ignore[arg-type]
