"""Lamps in the room through the whole spine: found over some frames, told in the message, kept out of the sky."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from client.sources.volume import Volume, default_volume, default_voxel
from client.synthetic.source import SyntheticSource, open_synthetic
from protocol.frames import CameraModel
from protocol.messages import Wishes
from server.client_session import ClientSession
from server.light import lamp_finder
from server.light.lamp_finder import FIRST_VIEWS, FRAMES_A_VIEW, STEPS_A_FRAME, LampFinder
from server.light.near_samples import LOBES, PooledSamples
from server.maths.emitters import Emitter
from server.maths.near_light import LONG_STEP, STEP, Found, Steps
from server.maths.sh import LUMINANCE
from server.opencl.device import Device
from server.opencl.engine import Engine
from server.pipeline import FrameResult
from tests.scenes.plain_light import PLAIN_LIGHT

FRAMES = range(0, 128, 2)
"""Three views, a search of 29 frames, and ten more for the sky to follow."""
CAMERA = CameraModel(width=64, height=48, fx=60.0, fy=60.0, cx=31.5, cy=23.5)


@cache
def source_of(spec: str) -> tuple[SyntheticSource, Volume]:
    """A scene and its volume."""
    source = open_synthetic(f"synthetic:{spec}&size=160x120&frames=150")
    return source, default_volume(source, range(len(source)))


def results_of(device: Device, spec: str, frames: range = FRAMES, **wishes: str) -> list[FrameResult]:
    source, bounds = source_of(spec)
    asked = Wishes(volume_m=bounds, voxel_m=default_voxel(bounds), up=source.up, **PLAIN_LIGHT, **wishes)
    pipeline = ClientSession(device, source.camera, asked)
    try:
        return [pipeline.process(replace(source[index], index=index)) for index in frames]
    finally:
        pipeline.close()


def test_lamp_is_found_and_leaves_the_sky(device: Device) -> None:
    results = results_of(device, "lamp?place=5")
    first, last = results[0], results[-1]
    assert first.light.lamps == ()
    (lamp,) = last.light.lamps
    (true,) = open_synthetic("synthetic:lamp?place=5&size=160x120").lamps
    assert np.linalg.norm(np.array(lamp.position_m) - true.position) < 0.03  # seen: 0.012
    np.testing.assert_allclose(lamp.intensity, true.intensity, rtol=0.03)  # seen: 0.013
    assert 0 < max(lamp.position_std_m) < 0.03  # seen: 0.010
    assert lamp.share > 0.6
    without = results_of(device, "lamp?place=5", FRAMES[:1], lamps="off")[0]
    mean = [float(np.array(result.light.sh[0]) @ LUMINANCE) for result in (last, without)]
    assert mean[0] < 0.5 * mean[1]  # the lamp's light is four fifths of all
    (item,) = [item for item in last.plan.left_out if item.effect == "lamplight"]
    assert item.error_bound is None


@pytest.mark.parametrize("spec", ["room?light=1", "table?light=3"])
def test_nothing_is_found_where_there_is_none(device: Device, spec: str) -> None:
    for result in results_of(device, spec, FRAMES[:45]):
        assert result.light.lamps == ()
        assert "lamplight" not in {item.effect for item in result.plan.left_out}


def test_search_waits_for_views_forgets_and_can_be_off(engine: Engine, monkeypatch: pytest.MonkeyPatch) -> None:
    """The order of things, with views and searches that cost nothing."""
    views, contradicting = [], False
    lamp = Emitter(np.zeros(3), np.ones(3), np.eye(3), np.ones(3), 0.9, 0.5)

    def search(*_: object, **__: object) -> Steps[Found]:
        yield LONG_STEP
        for _step in range(6):
            yield STEP
        yield LONG_STEP
        return Found((lamp,), np.zeros(1), 0.01)

    def see(*_: object) -> PooledSamples:
        views.append(finder)
        return PooledSamples(*(np.zeros((5, 3)) for _ in range(3)), np.zeros((5, LOBES)))

    monkeypatch.setattr(lamp_finder, "see_some", see)
    monkeypatch.setattr(lamp_finder, "search_lamps", search)
    monkeypatch.setattr(LampFinder, "_contradicts", lambda *_: contradicting)
    finder = LampFinder(engine, "auto")

    def frames_until(lamps: int) -> int:
        count = 0
        while len(finder.lamps) != lamps:
            finder.work(CAMERA, None, None, None)
            count += 1
        return count

    assert LONG_STEP < STEPS_A_FRAME < 2 * LONG_STEP
    assert STEPS_A_FRAME == 6 * STEP
    searching = 3  # of frames: one or two with a long piece and short ones, and a view between
    assert frames_until(1) == FIRST_VIEWS * FRAMES_A_VIEW + searching
    assert len(views) == FIRST_VIEWS + 1
    assert finder.left_out()[0].effect == "lamplight"
    contradicting = True
    assert frames_until(0) == 1  # the next view is one search later
    contradicting = False
    assert frames_until(1) > FIRST_VIEWS
    finder = LampFinder(engine, "off")
    seen = len(views)
    finder.work(CAMERA, None, None, None)
    assert len(views) == seen
