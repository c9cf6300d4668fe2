"""A tracked camera covered, thrown about, or taken away: it says that it is lost, harms nothing, and comes back."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pytest

from protocol.frames import RgbdFrame
from server.client_session import ClientSession
from server.geometry.geometry import Geometry, GeometryFrame
from server.maths.registration import distance_between
from server.opencl.device import Device
from server.opencl.engine import Engine
from server.tracking.relocalize import GREATEST_COUNT, Keyframes, dissimilarity, thumbnail
from tests.scenes.analytic import Floats, look, look_at, plane, sphere
from tests.scenes.rooms import CAMERA, ROOM, VOXEL_M, frame_at, view_at, wishes

SIZE = (CAMERA.height, CAMERA.width)
AWAY = look_at((1.1, 0.0, 0.5), (1.6, 0.5, -0.4))
"""2 m from the way, towards a corner that was never seen."""
BAD_DEPTH = {
    "empty": np.zeros(SIZE, np.uint16),
    "covered lens": np.full(SIZE, 1, np.uint16),
    "covered lens, 3 cm": np.full(SIZE, 30, np.uint16),
    "saturated": np.full(SIZE, 65535, np.uint16),
    "beyond 10 m": np.full(SIZE, 20_000, np.uint16),
    "one pixel": np.pad(np.full((1, 1), 1200, np.uint16), ((60, 59), (80, 79))),
    "noise": np.random.default_rng(0).integers(0, 65536, SIZE).astype(np.uint16),
    "alternating": np.indices(SIZE).sum(0).astype(np.uint16) % 2 * 1500,
    "a wall at 40 cm": np.full(SIZE, 400, np.uint16),
}


@pytest.fixture
def geometry(engine: Engine) -> Geometry:
    return Geometry(engine, CAMERA, wishes("track"))


@pytest.fixture
def pipeline(device: Device) -> Iterator[ClientSession]:
    pipeline = ClientSession(device, CAMERA, wishes("track"))
    yield pipeline
    pipeline.close()


def walk(geometry: Geometry, steps: range) -> GeometryFrame:
    """The result of the last of these steps of the way; every one of them must be tracked."""
    for step in steps:
        result = geometry.scan(frame_at(view_at(step), step, given=view_at(0)))
        assert result.tracking == "tracked"
    return result


def voxels(geometry: Geometry) -> bytes:
    """Everything that the volume holds."""
    assert geometry.volume is not None
    bricks = geometry.volume.download_bricks()
    return bricks.indices.tobytes() + bricks.tsdf.tobytes() + bricks.weight.tobytes()


def bad_frame(name: str, index: int = 50) -> RgbdFrame:
    return replace(frame_at(view_at(10), index), depth=BAD_DEPTH[name])


@pytest.mark.parametrize("name", BAD_DEPTH)
def test_bad_depth_is_lost_and_nothing_moves(geometry: Geometry, name: str) -> None:
    last = walk(geometry, range(11))
    before = voxels(geometry)
    for index in range(3):
        result = geometry.scan(bad_frame(name, 50 + index))
        assert result.tracking == "lost"
        assert any(note.startswith("the camera is lost, nothing is fused: ") for note in result.notes)
        np.testing.assert_array_equal(result.world_from_camera, last.world_from_camera)
    assert voxels(geometry) == before
    after = geometry.scan(frame_at(view_at(11), 11))
    assert after.tracking == "tracked"
    assert distance_between(after.world_from_camera, view_at(11)) < 0.15 * VOXEL_M


@pytest.mark.parametrize("name", BAD_DEPTH)
def test_a_session_that_begins_with_bad_depth_begins_when_it_gets_better(geometry: Geometry, name: str) -> None:
    first = geometry.scan(bad_frame(name))
    if name == "a wall at 40 cm":  # nobody can know that this is no wall
        return
    assert first.tracking == "lost"
    assert any("too little depth" in note for note in first.notes)
    assert geometry.volume is not None
    assert geometry.volume.allocated_bricks == 0
    walk(geometry, range(6))


def test_a_camera_that_jumps_2_m_comes_back(geometry: Geometry) -> None:
    """To where it was, and to other places that it has been at: by what it sees there."""
    walk(geometry, range(61))
    before = voxels(geometry)
    assert distance_between(AWAY, view_at(60)) > 1.9
    for index in range(3):
        result = geometry.scan(frame_at(AWAY, 100 + index))
        assert result.tracking == "lost"
    assert voxels(geometry) == before
    assert distance_between(view_at(60), view_at(28)) > 0.25
    for step in (28, 29, 60):
        geometry.scan(frame_at(AWAY, 100))
        back = geometry.scan(frame_at(view_at(step), 200 + step))
        assert back.tracking == "tracked"
        assert distance_between(back.world_from_camera, view_at(step)) < 0.3 * VOXEL_M
    walk(geometry, range(61, 64))


def test_another_room_is_not_taken_for_this_one(geometry: Geometry) -> None:
    walk(geometry, range(40))
    before = voxels(geometry)
    elsewhere = [plane((0, 0, 1.2), (0.3, 0.2, -1)), sphere((0.2, 0.1, 0.8), 0.2), sphere((-0.3, 0.1, 0.9), 0.15)]
    for index in range(5):
        frame = frame_at(np.eye(4), 70 + index, scene=elsewhere)
        assert geometry.scan(frame).tracking == "lost"
    assert voxels(geometry) == before


def test_a_plain_wall_does_not_end_being_lost(geometry: Geometry) -> None:
    """It fits any place along itself: no place can be known by it."""
    view = look_at((-0.9, -0.1, 2.0), (-0.9, -0.1, 2.5))
    walk(geometry, range(30))
    geometry.scan(frame_at(AWAY, 100))
    assert (look(ROOM, CAMERA, view).depth_m > 0).all()
    for index in range(3):
        assert geometry.scan(frame_at(view, 101 + index)).tracking == "lost"


def test_a_hand_over_a_third_of_the_picture_is_no_loss(geometry: Geometry) -> None:
    walk(geometry, range(10))
    view = view_at(10)
    hand = sphere(view[:3, 3] + 0.45 * view[:3, 2] + 0.1 * view[:3, 0], 0.145)
    frame = frame_at(view, 10, scene=[*ROOM, hand])
    assert (frame.depth != frame_at(view, 10).depth).mean() > 0.3
    result = geometry.scan(frame)
    assert result.tracking == "tracked"
    assert distance_between(result.world_from_camera, view) < 0.2 * VOXEL_M


def test_a_lost_frame_shows_the_cameras_picture_and_the_last_light(pipeline: ClientSession) -> None:
    for step in range(4):
        before = pipeline.process(frame_at(view_at(step), step, given=view_at(0)))
    frame = bad_frame("covered lens")
    result = pipeline.process(frame)
    assert result.tracking == "lost"
    np.testing.assert_array_equal(result.color, frame.color)
    assert result.light.sh == before.light.sh
    np.testing.assert_array_equal(result.world_from_camera, before.world_from_camera)
    assert result.plan.run == ()
    assert {left.reason for left in result.plan.left_out} == {"the camera is lost"}
    assert pipeline.process(frame_at(view_at(4), 4)).tracking == "tracked"


@pytest.mark.parametrize("name", ["empty", "covered lens", "one pixel"])
def test_a_stream_that_begins_lost_has_a_picture_and_no_light(pipeline: ClientSession, name: str) -> None:
    frame = bad_frame(name)
    result = pipeline.process(frame)
    assert result.tracking == "lost"
    np.testing.assert_array_equal(result.color, frame.color)
    assert not result.light.valid
    assert np.isfinite(result.world_from_camera).all()
    assert pipeline.process(frame_at(view_at(0), 1, given=view_at(0))).tracking == "tracked"


def test_poses_that_are_none_are_refused_where_they_are_used(geometry: Geometry, engine: Engine) -> None:
    mirrored = np.diag([-1.0, 1, 1, 1])
    with pytest.raises(ValueError, match="not a rotation"):
        geometry.scan(frame_at(view_at(0), 0, given=mirrored))
    walk(geometry, range(2))
    geometry.scan(frame_at(view_at(2), 2, given=mirrored))  # tracked: its pose is not asked for
    refine = Geometry(engine, CAMERA, wishes("refine"))
    with pytest.raises(ValueError, match="--poses track"):
        refine.scan(frame_at(view_at(0), 0))


def test_thumbnails_know_a_place_again() -> None:
    """Brighter, noisier and a little farther on, a view is still nearest to itself."""
    steps = (0, 12, 24, 36)
    kept = [thumbnail(frame_at(view_at(s)), look(ROOM, CAMERA, view_at(s)).depth_m.astype(np.float32)) for s in steps]
    for number, step in enumerate(steps):
        frame = frame_at(view_at(step + 1), 1, noise_m=0.01)
        dark = replace(frame, color=(frame.color * 0.5).astype(np.uint8))
        seen = thumbnail(dark, (frame.depth * 1e-3).astype(np.float32))
        assert np.argmin([dissimilarity(seen, other) for other in kept]) == number
    black = thumbnail(replace(frame, color=np.zeros_like(frame.color)), np.zeros(SIZE, np.float32))
    assert np.isfinite([dissimilarity(black, other) for other in [*kept, black]]).all()


def test_keyframes_are_bounded_and_spread_out() -> None:
    keyframes, seen = Keyframes(), thumbnail(frame_at(view_at(0)), np.ones(SIZE, np.float32))
    poses: list[Floats] = []
    for number in range(GREATEST_COUNT + 30):
        pose = np.eye(4)
        pose[0, 3] = 0.3 * number
        assert keyframes.is_new(pose)
        keyframes.add(seen, pose)
        poses.append(pose)
    assert len(keyframes) == GREATEST_COUNT
    assert not keyframes.is_new(keyframes.most_similar(seen, 1)[0])
    kept = np.sort([pose[0, 3] for pose in keyframes.most_similar(seen, GREATEST_COUNT)])
    assert np.diff(kept).max() < 4 * 0.3
