"""The check at the server's start: who computes well passes it with room to spare, who does not is told."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from msgspec import structs

from protocol.frames import RgbdFrame
from server.client_session import ClientSession
from server.opencl.device import Device
from server.pipeline import FrameResult
from server.service import self_check
from server.service.self_check import (
    LEAST_OBJECT_PIXELS,
    LIGHT_BOUND_DEG,
    CheckFailed,
    check_answers,
    check_light,
    check_object,
    check_picture,
)


@pytest.fixture(scope="module")
def results(device: Device) -> tuple[FrameResult, FrameResult]:
    """Of the frame without objects, and of the one with."""
    kept: list[FrameResult] = []
    process = ClientSession.process
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(ClientSession, "process", lambda self, frame: kept.append(process(self, frame)) or kept[-1])
        check_answers(device)
    assert len(kept) == 4
    return kept[1], kept[3]


def told(check: object, result: FrameResult) -> str:
    with pytest.raises(CheckFailed) as failed:
        check(result)
    assert failed.value.check in str(failed.value)
    assert "\n" not in str(failed.value)
    return failed.value.check


def test_there_is_room_to_spare(results: tuple[FrameResult, FrameResult], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(self_check, "LIGHT_BOUND_DEG", LIGHT_BOUND_DEG / 3)
    check_light(results[0])
    monkeypatch.setattr(self_check, "LEAST_OBJECT_PIXELS", 2 * LEAST_OBJECT_PIXELS)
    check_object(results[1])


def test_one_wrong_pixel_is_told(results: tuple[FrameResult, FrameResult]) -> None:
    color = results[0].color.copy()
    color[3, 4, 1] += 1
    assert told(check_picture, replace(results[0], color=color)) == "picture"


@pytest.mark.parametrize("direction", [(0.0, 0.0, 0.0), (0.0, 0.0, -1.0), (0.5, 0.5, -0.7), (np.nan,) * 3])
def test_a_wrong_light_is_told(results: tuple[FrameResult, FrameResult], direction: tuple[float, ...]) -> None:
    light = structs.replace(results[0].light, dominant_direction=direction)
    assert told(check_light, replace(results[0], light=light)) == "light"


def test_a_light_that_is_not_finite_is_told(results: tuple[FrameResult, FrameResult]) -> None:
    light = structs.replace(results[0].light, sh=((np.inf, 0.0, 0.0),) * 16)
    assert told(check_light, replace(results[0], light=light)) == "light"


def test_an_object_that_is_not_there_or_has_a_wrong_colour_is_told(results: tuple[FrameResult, FrameResult]) -> None:
    assert told(check_object, results[0]) == "object"
    darker = (results[1].color * 0.9).astype(np.uint8)
    assert told(check_object, replace(results[1], color=darker)) == "object"


def test_a_device_that_computes_what_is_wrong_is_told(device: Device, monkeypatch: pytest.MonkeyPatch) -> None:
    process = ClientSession.process

    def with_a_flat_ball(self: ClientSession, frame: RgbdFrame) -> FrameResult:
        depth = np.where(frame.depth < 1500, 700 + (np.arange(64) * 6).astype(np.uint16), frame.depth)
        return process(self, replace(frame, depth=depth.astype(np.uint16)))

    monkeypatch.setattr(ClientSession, "process", with_a_flat_ball)
    with pytest.raises(CheckFailed, match="check 'light': its direction is"):
        check_answers(device)
