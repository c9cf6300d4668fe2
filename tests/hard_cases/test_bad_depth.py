"""Depth and poses that no camera should deliver, through the whole pipeline: nothing crashes, nothing is not a number.

What is wrong is said: in the frame's notes, or as a ValueError of one line that leaves the session as it was.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import closing
from itertools import product
from typing import Any

import msgspec
import numpy as np
import pytest
from msgspec.structs import replace

from protocol.frames import CameraModel, RgbdFrame
from protocol.messages import Wishes
from server.client_session import ClientSession
from server.opencl.device import Device
from server.pipeline import FrameResult
from server.scene.placement import Placement
from tests.scenes.analytic import look_at
from tests.scenes.bad_depth import (
    BAD_DEPTH,
    BOUNDS,
    CAMERA,
    PYRAMID,
    SIZE,
    USUAL,
    WISHES,
    Matrix,
    assert_sound,
    frame_of,
    good_depth,
    numbers,
)
from tests.scenes.meshes import soup_of

Open = Callable[..., ClientSession]
Place = tuple[float, float, float]


def session_with_an_object(
    device: Device, wishes: Wishes = WISHES, offset: Any = (0.0, 0.0, 0.0), camera: CameraModel = CAMERA
) -> ClientSession:
    pipeline = ClientSession(device, camera, wishes)
    x, y, z = (float(value) for value in np.array([-0.2, 0.7, 1.1]) + offset)
    pipeline.place_object("pyramid", soup_of(PYRAMID), Placement(position_m=(x, y, z)))
    return pipeline


@pytest.fixture
def open_pipeline(device: Device) -> Iterator[Open]:
    """Makes pipelines with one object that stands in the room, and closes them."""
    made: list[ClientSession] = []

    def start(*given: Any, **named: Any) -> ClientSession:
        made.append(session_with_an_object(device, *given, **named))
        return made[-1]

    yield start
    for pipeline in made:
        pipeline.close()


def lit(pipeline: ClientSession, offset: Any = (0.0, 0.0, 0.0)) -> FrameResult:
    """The result of some good frames."""
    for index, x in enumerate((0.0, 0.1, 0.2)):
        view = look_at((x, -0.2, 0.0), (0.1, 0.3, 1.2))
        moved = view.copy()
        moved[:3, 3] += offset
        frame = frame_of(good_depth(view), view, index)
        result = pipeline.process(RgbdFrame(index, frame.timestamp_s, frame.color, frame.depth, moved))
    return result


@pytest.mark.parametrize("name", BAD_DEPTH)
def test_bad_depth_from_the_start(open_pipeline: Open, name: str) -> None:
    """A session may begin with it, and gets well as soon as the depth does."""
    pipeline = open_pipeline(USUAL)
    for index in range(3):
        result = pipeline.process(frame_of(BAD_DEPTH[name], index=index))
        assert_sound(result)
    if name in ("empty", "saturated", "beyond 10 m"):
        assert "the depth picture has no usable value: is the sensor covered?" in result.notes
    if name in ("empty", "saturated", "beyond 10 m"):
        assert any("the light is unknown" in note for note in result.notes)
        assert not result.light.valid
        assert not numbers(msgspec.to_builtins(result.light.sh))[0]
    after = lit(pipeline)
    assert_sound(after)
    assert not any("unknown" in note for note in after.notes)
    assert np.abs(after.light.dominant_direction).max() > 0


def in_between(pipeline: ClientSession, depth: Any) -> FrameResult:
    """The result of good frames, before and after three with this depth."""
    view = look_at((0.2, -0.2, 0.0), (0.1, 0.3, 1.2))
    lit(pipeline)
    for index in range(3, 6):
        assert_sound(pipeline.process(frame_of(depth, view, index)))
    result = lit(pipeline)
    assert_sound(result)
    return result


@pytest.fixture(scope="module")
def good_in_between(device: Device) -> FrameResult:
    """That of good depth, for every kind of bad one."""
    with closing(session_with_an_object(device)) as pipeline:
        return in_between(pipeline, good_depth(look_at((0.2, -0.2, 0.0), (0.1, 0.3, 1.2))))


@pytest.fixture(scope="module")
def lit_twice(device: Device) -> FrameResult:
    """Of a session that had no wrong frame in between."""
    with closing(session_with_an_object(device)) as pipeline:
        lit(pipeline)
        return lit(pipeline)


@pytest.mark.parametrize("name", BAD_DEPTH)
def test_bad_depth_in_between(open_pipeline: Open, good_in_between: FrameResult, name: str) -> None:
    """A light that was found stays finite; the reconstruction is not lost, and stands in for depth that is missing."""
    results = in_between(open_pipeline(), BAD_DEPTH[name]), good_in_between
    if name in ("empty", "saturated", "beyond 10 m", "one pixel"):
        bad, good = (np.array(result.light.dominant_direction) for result in results)
        # Three frames from the side are in the one light and not in the other. Seen: 10.1.
        assert np.degrees(np.arccos(np.clip(bad @ good, -1, 1))) < 11
        assert (np.abs(results[0].color.astype(int) - results[1].color) > 8).mean() < 0.001  # seen: 0.0003


@pytest.mark.parametrize("name", ["empty", "saturated", "beyond 10 m"])
def test_depth_without_a_usable_value_is_named(open_pipeline: Open, name: str) -> None:
    """Also once a light has been found, when nothing else says that something is wrong."""
    pipeline = open_pipeline()
    lit(pipeline)
    assert any("depth" in note for note in pipeline.process(frame_of(BAD_DEPTH[name])).notes)


@pytest.mark.parametrize("scale", [1e-9, 1e-4, 10.0, 1e6])
def test_any_depth_scale(open_pipeline: Open, scale: float) -> None:
    pipeline = open_pipeline(camera=replace(CAMERA, depth_scale_m=scale))
    for index, depth in enumerate(BAD_DEPTH.values()):
        assert_sound(pipeline.process(frame_of(depth, index=index)))


@pytest.mark.parametrize(
    "eye", [(1.08, 0.0, 1.0), (1.14, 0.0, 1.0), (0.2, 0.4, 1.2), (0.0, 0.0, 2.05), (3.0, 0.0, 1.0)]
)
def test_a_camera_inside_a_wall(open_pipeline: Open, eye: tuple[float, float, float]) -> None:
    """In and behind surface that was fused before, with the depth of the scene, none, and of what it stands in."""
    pipeline = open_pipeline()
    lit(pipeline)
    for index, target in enumerate(((0.0, 0.1, 1.0), (1.2, 0.1, 1.0), (1.08, 0.9, 1.0), (0.2, 0.4, 1.3))):
        view = look_at(eye, np.array(target) + 1e-3)
        for depth in (good_depth(view), np.zeros(SIZE, np.uint16), np.full(SIZE, 20, np.uint16)):
            assert_sound(pipeline.process(frame_of(depth, view, index)))
    assert_sound(lit(pipeline))


@pytest.mark.parametrize(
    ("wishes", "near_m", "far_m"),
    [
        pytest.param(WISHES, (0.0, 0.0, 0.0), (9.9e3, 0.0, 0.0), id="offset0"),
        pytest.param(WISHES, (0.0, 0.0, 0.0), (-7e3, 7e3, -5e3), id="offset1"),
        pytest.param(USUAL, (6.0, 0.0, 0.0), (9985.2, 0.0, 0.0), id="usual"),
    ],
)
def test_a_scene_10_km_from_the_origin(open_pipeline: Open, wishes: Wishes, near_m: Place, far_m: Place) -> None:
    """Poses are relative to the volume in float64 before they become float32: the same light and picture.

    The usual model of light has cells in the world, of 0.15, 0.4 and 0.6 m: it is moved by whole ones, from where no
    wall lies between two of them.
    """
    near, far = (
        lit(open_pipeline(replace(wishes, volume_m=tuple(np.array(BOUNDS) + np.tile(offset, 2))), offset), offset)
        for offset in (near_m, far_m)
    )
    assert_sound(far)
    np.testing.assert_allclose(far.light.sh, near.light.sh, atol=1e-3 * np.abs(near.light.sh).max())
    assert (np.abs(far.color.astype(int) - near.color) > 1).mean() < 2e-3


@pytest.mark.parametrize("distance_m", [30.0, 1e4, 1e9])
def test_a_volume_far_from_the_camera(open_pipeline: Open, distance_m: float) -> None:
    """A wrong volume: nothing is fused, what the sensor sees still is real geometry."""
    view = look_at((0.0, 0.0, 0.0), (0.1, 0.3, 1.2))
    pose = view.copy()
    pose[:3, 3] += distance_m
    frame = frame_of(good_depth(view), view)
    result = open_pipeline().process(RgbdFrame(0, 0.0, frame.color, frame.depth, pose))
    assert_sound(result)


@pytest.mark.parametrize("size", [1e-9, 1e-5, 5e-3])
def test_a_pose_that_is_nearly_a_rotation_is_repaired(open_pipeline: Open, size: float) -> None:
    view = look_at((0.1, -0.2, 0.0), (0.1, 0.3, 1.2))
    bent = view.copy()
    bent[:3, :3] += size * np.random.default_rng(1).uniform(-0.4, 0.4, (3, 3))
    result = open_pipeline().process(RgbdFrame(0, 0.0, frame_of(good_depth(view), view).color, good_depth(view), bent))
    assert_sound(result)
    assert np.linalg.det(result.world_from_camera[:3, :3]) == pytest.approx(1)
    np.testing.assert_allclose(result.world_from_camera, view, atol=2 * size + 1e-12)
    # The nearest rotation: no other is nearer to what came.
    for axis in np.vstack([np.eye(3), -np.eye(3)]):
        turn = np.eye(3) + 1e-4 * np.cross(np.eye(3), axis)
        other = np.linalg.qr(turn)[0] * np.sign(np.diag(np.linalg.qr(turn)[1])) @ result.world_from_camera[:3, :3]
        ours = np.linalg.norm(result.world_from_camera[:3, :3] - bent[:3, :3])
        assert np.linalg.norm(other - bent[:3, :3]) > ours


def pose_with(index: tuple[Any, ...], value: float) -> Matrix:
    pose = np.eye(4)
    pose[index] = value
    return pose


NO_POSES: dict[str, Matrix | None] = {
    "mirrored": np.diag([-1.0, 1.0, 1.0, 1.0]),
    "scaled": np.diag([2.0, 2.0, 2.0, 1.0]),
    "sheared": pose_with((0, 1), 0.3),
    "singular": pose_with((2, 2), 0.0),
    "zeros": np.zeros((4, 4)),
    "not a number": pose_with((0, 0), np.nan),
    "infinite translation": pose_with((1, 3), np.inf),
    "column-major": pose_with((3, 0), 1.5),
    "3 x 4": np.eye(4)[:3],
    "missing": None,
}


@pytest.mark.parametrize("name", NO_POSES)
def test_what_is_no_pose_is_refused(open_pipeline: Open, lit_twice: FrameResult, name: str) -> None:
    pipeline = open_pipeline()
    before = lit(pipeline)
    good = frame_of(good_depth(np.eye(4)))
    with pytest.raises(ValueError, match=r"world_from_camera|pose") as caught:
        pipeline.process(RgbdFrame(9, 0.3, good.color, good.depth, NO_POSES[name]))
    assert "\n" not in str(caught.value)
    after = lit(pipeline)  # as if the frame had never come
    np.testing.assert_array_equal(after.color, lit_twice.color)
    assert after.light == lit_twice.light
    assert before.color.shape == good.color.shape


def test_pictures_of_another_size_are_refused(open_pipeline: Open) -> None:
    pipeline = open_pipeline()
    good = frame_of(good_depth(np.eye(4)))
    for color, depth in ((good.color[:-1], good.depth), (good.color, good.depth[:, :-1]), (good.color.T, good.depth.T)):
        with pytest.raises(ValueError, match=r"the camera has 96x72"):
            pipeline.process(RgbdFrame(0, 0.0, color, depth, np.eye(4)))
    assert_sound(lit(pipeline))


def test_pictures_of_another_type_are_refused(open_pipeline: Open) -> None:
    pipeline = open_pipeline()
    good = frame_of(good_depth(np.eye(4)))
    for color, depth in (
        (good.color / 255, good.depth),
        (good.color.astype(np.uint16), good.depth),
        (good.color, good.depth * 1e-3),
    ):
        with pytest.raises(
            ValueError, match=r"colour is of type \w+, depth of \w+; srgb8 is uint8, depth uint16"
        ) as caught:
            pipeline.process(RgbdFrame(0, 0.0, color, depth, np.eye(4)))
        assert "\n" not in str(caught.value)
    assert_sound(lit(pipeline))


@pytest.mark.parametrize("name", ["empty", "saturated", "one pixel"])
def test_a_live_session_waits_for_depth_to_place_its_volume(open_pipeline: Open, name: str) -> None:
    pipeline = open_pipeline(Wishes(voxel_m=0.04))
    with pytest.raises(ValueError, match="has no depth to place a volume around"):
        pipeline.process(frame_of(BAD_DEPTH[name]))
    assert_sound(lit(pipeline))


def test_a_black_and_a_white_picture(open_pipeline: Open) -> None:
    """Good depth, no usable radiance: no light, and none of what is clipped, which tells the usual model how much it
    is at least."""
    depth = good_depth(np.eye(4))
    for wishes, code in product((WISHES, USUAL), (0, 255)):
        pipeline = open_pipeline(wishes)
        color = np.full((*SIZE, 3), code, np.uint8)
        for index in range(3):
            result = pipeline.process(RgbdFrame(index, index / 30, color, depth, np.eye(4)))
        assert_sound(result)
        assert not result.light.valid
        is_bounded = wishes == USUAL and code == 255
        assert is_bounded or any("the light is unknown" in note for note in result.notes)
        assert (result.color == code).mean() > 0.99  # all but the object, which nothing lights
