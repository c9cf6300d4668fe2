"""When a view that stands still rests: what has to have settled, and what wakes it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from protocol.frames import CameraModel, RgbdFrame
from server.culling.reason import ALLOWANCE, CullReason
from server.opencl.engine import Engine
from server.reuse.temporal_reuse import (
    ECHO_FRAMES,
    NOISE,
    NOISY,
    RATE,
    ROUND,
    ROUNDING,
    SAME,
    SHARE,
    SceneVersion,
    TemporalReuse,
)
from server.transfer.radiance_transfer import TURNS
from tests.scenes import lights

CAMERA = CameraModel(width=64, height=48, fx=50.0, fy=50.0, cx=31.5, cy=23.5)
SHAPE = (48, 64)
FRAME = RgbdFrame(0, 0.0, np.full((*SHAPE, 3), 90, np.uint8), np.full(SHAPE, 900, np.uint16), np.eye(4), 1.0)
SCENE = SceneVersion()
LIGHT = lights.lobe_and_sky((0.3, 0.8, 0.4))[None]
PICTURE = np.full((*SHAPE, 3), 90, np.uint8)
PLANES: Any = (np.ones((1, 4, 4), np.float32), np.ones((1, 4), np.int32), np.zeros(1, np.uint8))


def noisy(index: int) -> RgbdFrame:
    """FRAME with a sensor's noise."""
    noise = np.random.default_rng(index)
    color = np.rint(FRAME.color + noise.normal(0, 2.5, FRAME.color.shape)).astype(np.uint8)
    depth = np.rint(FRAME.depth + noise.normal(0, 2.0, SHAPE)).astype(np.uint16)
    return replace(FRAME, index=index, color=color, depth=depth)


def fed(reuse: TemporalReuse, frames: int, step: float = 0.0, **learnt: Any) -> CullReason | None:
    """What is found after so many frames that are alike, whose light grows by the share `step` each."""
    for index in range(frames):
        decision = reuse.decide(replace(FRAME, index=index), SCENE)
        sh = LIGHT * (1 + index * step)
        reuse.observe(decision, sh, learnt.get("picture") if decision.is_checkpoint else None)
    return reuse._reason


def fed_noise(reuse: TemporalReuse, frames: int, pictures: Any = lambda _index: PICTURE) -> CullReason | None:
    """The same of frames that differ by noise."""
    for index in range(frames):
        decision = reuse.decide(noisy(index), SCENE)
        reuse.observe(decision, LIGHT, pictures(index) if decision.is_checkpoint else None)
    return reuse._reason


def test_it_rests_once_a_round_has_repeated(engine: Engine) -> None:
    assert fed(TemporalReuse(engine, CAMERA), ROUND - 1) is None
    assert fed(TemporalReuse(engine, CAMERA), ROUND) == CullReason(SAME, 0.0)
    assert fed(TemporalReuse(engine, CAMERA), ROUND, picture=PICTURE) == CullReason(SAME, ROUNDING)


@pytest.mark.parametrize(
    "change",
    [
        {"color": FRAME.color + np.uint8(1)},
        {"depth": FRAME.depth + np.uint16(9)},
        {"exposure": 2.0},
        {"world_from_camera": np.eye(4) + np.eye(4, k=3) * 1e-3},
    ],
)
def test_what_is_new_is_looked_at(engine: Engine, change: dict[str, Any]) -> None:
    reuse = TemporalReuse(engine, CAMERA)
    assert fed(reuse, ROUND) is not None
    before = reuse.decide(FRAME, SCENE)
    assert before.keeps_geometry
    changed = reuse.decide(replace(FRAME, **change), SCENE)
    assert not changed.keeps_geometry
    assert changed.reason is None
    assert changed.version.view != before.version.view
    assert not reuse.decide(FRAME, SCENE).keeps_geometry  # and so is what then follows


@pytest.mark.parametrize(
    "scene",
    [SceneVersion(others=1), SceneVersion(losses=1), SceneVersion(sampling=1), SceneVersion(lamps=(object(),))],  # type: ignore[arg-type]
)
def test_what_pictures_do_not_show_begins_a_view(engine: Engine, scene: SceneVersion) -> None:
    reuse = TemporalReuse(engine, CAMERA)
    assert fed(reuse, ROUND) is not None
    assert not reuse.decide(FRAME, scene).keeps_geometry


def test_an_object_that_moves_is_drawn_anew_in_a_view_that_holds(engine: Engine) -> None:
    reuse, thing = TemporalReuse(engine, CAMERA), object()
    objects: Any = [(thing, np.eye(4))]
    assert fed(reuse, ROUND) is not None
    first, same = (reuse.decide(FRAME, SCENE, objects) for _ in range(2))
    moved = reuse.decide(FRAME, SCENE, [(thing, 2 * np.eye(4))])  # type: ignore[list-item]
    assert first.version.objects == same.version.objects != moved.version.objects
    assert moved.keeps_geometry
    assert moved.samples_version.view == first.samples_version.view


def test_a_light_that_still_moves_is_followed(engine: Engine) -> None:
    slow, fast = 1e-5 * RATE, 1e-2 * RATE
    assert fed(TemporalReuse(engine, CAMERA), ROUND, fast) is None
    found = fed(TemporalReuse(engine, CAMERA), ROUND, slow, picture=PICTURE)
    assert found is not None
    assert ROUNDING < found.error_bound <= SHARE * ALLOWANCE
    # A light that is ten steps off, everywhere alike, changes shadings by a hundred-thousandth, their ratios by two.
    assert found.error_bound - ROUNDING == pytest.approx(2e-5 * 255 * 1.055 / 2.4, rel=0.02)


def test_it_rests_under_noise(engine: Engine) -> None:
    assert fed_noise(TemporalReuse(engine, CAMERA), NOISY - 1) is None
    assert fed_noise(TemporalReuse(engine, CAMERA), NOISY) == CullReason(NOISE, ALLOWANCE)


def test_transfer_is_renewed_once_before_a_view_settles(engine: Engine) -> None:
    """Before the first of the pictures that are compared; not for a camera that does not rest."""

    def renewed(reuse: TemporalReuse, frame: Callable[[int], RgbdFrame]) -> list[int]:
        frames = []
        for index in range(NOISY + 4):
            decision = reuse.decide(frame(index), SCENE)
            reuse.observe(decision, LIGHT, PICTURE if decision.is_checkpoint else None)
            frames += [index] if decision.renews_transfer else []
        return frames

    assert renewed(TemporalReuse(engine, CAMERA), noisy) == [TURNS - 1]
    assert TURNS < NOISY // 2
    assert not renewed(TemporalReuse(engine, CAMERA, poses="track"), noisy)
    assert renewed(TemporalReuse(engine, CAMERA), lambda index: replace(FRAME, index=index)) == [TURNS - 1]


def test_a_picture_that_has_not_settled_is_drawn_anew(engine: Engine) -> None:
    """Two codes at one pixel in a hundred, between half the frames and all."""
    spotted = PICTURE.copy()
    spotted[::10, ::10] += 2
    reuse = TemporalReuse(engine, CAMERA)
    assert fed_noise(reuse, NOISY, lambda index: spotted if index + 1 == NOISY else PICTURE) is None


def test_a_tracked_camera_with_objects_does_not_rest(engine: Engine) -> None:
    assert fed_noise(TemporalReuse(engine, CAMERA, poses="track"), NOISY) is None
    assert fed_noise(TemporalReuse(engine, CAMERA, poses="track"), NOISY, lambda _index: None) is not None


def test_the_surface_is_renewed_when_twice_as_many_frames_were_seen(engine: Engine) -> None:
    reuse = TemporalReuse(engine, CAMERA)
    fed_noise(reuse, NOISY)
    decisions = [reuse.decide(noisy(index), SCENE) for index in range(NOISY, 2 * NOISY + 2)]
    kept = [decision.keeps_geometry for decision in decisions]
    assert kept == [index + 1 != 2 * NOISY for index in range(NOISY, 2 * NOISY + 2)]
    assert all(decision.reason is not None for decision in decisions)


def test_what_a_light_has_missed_is_said_afterwards(engine: Engine) -> None:
    still, moving = TemporalReuse(engine, CAMERA), TemporalReuse(engine, CAMERA)
    fed(still, ROUND)
    fed(moving, ROUND, 1e-5 * RATE)
    bright = replace(FRAME, exposure=2.0)
    assert still.decide(bright, SCENE).echo is None
    assert moving.decide(bright, SCENE).echo is not None
    for index in range(ECHO_FRAMES):
        moved = replace(bright, index=index, exposure=3.0 + index)
        moving.observe(moving.decide(moved, SCENE), LIGHT, None)
    assert moving.decide(bright, SCENE).echo is None
