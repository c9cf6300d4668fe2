"""What is noise and what is news: frames of a scene with a sensor's noise, and something small that happens in it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from protocol.frames import CameraModel, RgbdFrame
from server.opencl.engine import Engine
from server.reuse.change_detection import PARALLAX_PX, ChangeDetection, parallax_px

CAMERA = CameraModel(width=96, height=64, fx=80.0, fy=80.0, cx=47.5, cy=31.5)
NOISE_CODES, FRAMES = 2.0, 10
SCENE = np.add.outer(np.linspace(40, 200, 64), np.linspace(-30, 50, 96))[..., None].repeat(3, 2)
DEPTH = np.linspace(700, 3000, 64)[:, None].repeat(96, 1)

Change = Callable[[Any, Any], None]


def frame(seed: int, change: Change = lambda _color, _depth: None) -> RgbdFrame:
    """The scene once more, changed."""
    noise = np.random.default_rng(seed)
    color, depth = SCENE.copy(), DEPTH.copy()
    change(color, depth)
    color += noise.normal(0, NOISE_CODES, color.shape)
    depth += (depth > 0) * (1.2 + 1.9 * (depth / 1000 - 0.4) ** 2) * noise.normal(0, 1, depth.shape)
    pixels = np.rint(color).clip(0, 255).astype(np.uint8)
    return RgbdFrame(seed, 0.0, pixels, np.rint(depth).clip(0, 65535).astype(np.uint16), np.eye(4), 1.0)


def settled(engine: Engine) -> ChangeDetection:
    still = ChangeDetection(engine, CAMERA, poses_are_given=True)
    for seed in range(FRAMES):
        still.look(frame(seed), learn=True)
    return still


def test_noise_is_nothing_new(engine: Engine) -> None:
    still = settled(engine)
    assert still.count == FRAMES
    assert not still.is_exact
    assert all(still.look(frame(seed), learn=False) for seed in range(1000, 1060))


def small_thing(color: Any, _depth: Any) -> None:
    color[30:34, 40:44] += 15


def lamp_goes_out(color: Any, _depth: Any) -> None:
    color *= 0.98


def soft_shadow(color: Any, _depth: Any) -> None:
    color[:32, 32:64] -= 1.5
    color[:32, 64:] += 1.5  # so that the whole picture's mean tells nothing


def cloud(color: Any, _depth: Any) -> None:
    color -= 0.4


def dark_hand(_color: Any, depth: Any) -> None:
    depth[20:44, 30:50] = 650


def covered_sensor(_color: Any, depth: Any) -> None:
    depth[16:32, 16:32] = 0


def moved_a_little(color: Any, _depth: Any) -> None:
    color[:] = np.roll(color, 3, axis=0)


@pytest.mark.parametrize(
    "change", [small_thing, lamp_goes_out, soft_shadow, cloud, dark_hand, covered_sensor, moved_a_little]
)
def test_what_happens_is_seen_in_that_very_frame(engine: Engine, change: Change) -> None:
    still = settled(engine)
    assert still.look(frame(500), learn=False)
    assert not still.look(frame(501, change), learn=False)
    assert still.count == 1


@pytest.mark.parametrize("pattern", [np.ones((64, 96, 1)), (np.indices((64, 96)).sum(0) % 2 * 2.0 - 1)[..., None]])
def test_what_moves_everywhere_by_little_is_not_noise(engine: Engine, pattern: Any) -> None:
    """Less than noise from frame to frame: brighter by 0.4 codes, or brighter and darker by it in turn."""
    still = ChangeDetection(engine, CAMERA, poses_are_given=True)
    frames = [frame(i, lambda color, _depth, i=i: np.add(color, 0.4 * i * pattern, out=color)) for i in range(16)]
    assert not all([still.look(one, learn=True) for one in frames][1:])


def test_another_picture_is_not_noise_however_early(engine: Engine) -> None:
    still = ChangeDetection(engine, CAMERA, poses_are_given=True)
    still.look(frame(0), learn=True)
    assert not still.look(frame(1, lambda color, _depth: np.subtract(255, color, out=color)), learn=True)


def test_a_pose_that_is_told_counts_and_one_that_is_not_does_not(engine: Engine) -> None:
    pose = np.eye(4)
    pose[0, 3] = 0.01
    assert parallax_px(CAMERA, np.eye(4), pose) > PARALLAX_PX
    moved = replace(frame(77), world_from_camera=pose)
    assert not settled(engine).look(moved, learn=False)
    still = ChangeDetection(engine, CAMERA, poses_are_given=False)
    assert [still.look(f, learn=True) for f in (frame(0), replace(frame(1), world_from_camera=pose))] == [False, True]
