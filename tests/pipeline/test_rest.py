"""When the light need not be estimated anew."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from protocol.frames import RgbdFrame
from server.plan import ALLOWANCE, Omission
from server.rest import RATE, ROUND, SHARE, Rest
from server.stages.continuation import NO_PLANES
from tests import lights

FRAME = RgbdFrame(0, 0.0, np.full((4, 4, 3), 9, np.uint8), np.full((4, 4), 900, np.uint16), np.eye(4), 1.0)
LIGHT = lights.lobe_and_sky((0.3, 0.8, 0.4))
POSE: Any = SimpleNamespace(world_from_camera=np.eye(4))


def fed(rest: Rest, frames: int, step: float = 0.0, planes: Any = NO_PLANES) -> Omission | None:
    """What is found after so many frames that are alike, whose light grows by the share `step` each."""
    for index in range(frames):
        found = rest.found(replace(FRAME, index=index), POSE)
        if found is None:
            rest.learn(LIGHT * (1 + index * step), planes)
    return rest.found(FRAME, POSE)


def test_it_rests_once_a_round_has_repeated() -> None:
    assert fed(Rest(), ROUND) is None
    found = fed(Rest(), ROUND + 1)
    assert found is not None
    assert found.error_bound == 0.0


@pytest.mark.parametrize(
    "change",
    [
        {"color": FRAME.color + np.uint8(1)},
        {"depth": FRAME.depth + np.uint16(1)},
        {"exposure": 2.0},
    ],
)
def test_what_is_new_is_looked_at(change: dict[str, Any]) -> None:
    rest = Rest()
    assert fed(rest, ROUND + 1) is not None
    assert rest.found(replace(FRAME, **change), POSE) is None
    assert rest.found(FRAME, POSE) is None  # and so is what then follows


def test_another_view_or_other_lamps_are_new() -> None:
    rest = Rest()
    assert fed(rest, ROUND + 1) is not None
    aside = np.eye(4)
    aside[0, 3] = 1e-6
    assert rest.found(FRAME, SimpleNamespace(world_from_camera=aside)) is None  # type: ignore[arg-type]
    rest = Rest()
    assert fed(rest, ROUND + 1) is not None
    lamp: Any = object()
    assert rest.found(FRAME, POSE, (lamp,)) is None


def test_a_light_that_still_moves_is_followed() -> None:
    slow, fast = 1e-5 * RATE, 1e-2 * RATE
    assert fed(Rest(), ROUND + 1, fast) is None
    found = fed(Rest(), ROUND + 1, slow)
    assert found is not None
    assert 0 < found.error_bound <= SHARE * ALLOWANCE
    # A light that is ten steps off, everywhere alike, changes shadings by a hundred-thousandth, their ratios by two.
    assert found.error_bound == pytest.approx(2e-5 * 255 * 1.055 / 2.4, rel=0.02)


def test_planes_that_come_are_news() -> None:
    rest = Rest()
    fed(rest, ROUND)
    rest.learn(LIGHT, (np.ones((1, 4, 4), np.float32), np.ones((1, 4), np.int32), np.zeros(1, np.uint8)))
    assert rest.found(FRAME, POSE) is None
