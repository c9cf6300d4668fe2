"""Frames of a live camera do not wait for the light that is worked out beside them, but not for ever."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import msgspec
import numpy as np
import pytest

from client.options.source import open_source
from client.sources.volume import default_volume, default_voxel
from client.synthetic.source import SyntheticSource
from protocol.messages import Wishes
from server.client_session import ClientSession
from server.light.shell import room_model
from server.light.shell.room_model import LATEST_S, SOLVE_EVERY
from server.opencl.device import Device
from tests.scenes.analytic import Floats
from tests.scenes.turns import Alone

STEADY = 25
"""Frames after which two more are no tenth of all, for which a solution would begin at once."""


class Slow:
    """Work beside the frames that takes as long as the test wants."""

    begun: list[Slow]

    def __init__(self, work: Callable[[], Any]) -> None:
        self._work = work
        self.is_done = self.was_waited_for = False
        self.age_s = 0.0
        self.begun.append(self)

    def result(self) -> Any:
        self.was_waited_for = not self.is_done
        return self._work()


@pytest.fixture
def source() -> SyntheticSource:
    found = open_source("synthetic:table?frames=30&size=160x120&light=1")
    assert isinstance(found, SyntheticSource)
    return found


@pytest.fixture
def begun(monkeypatch: pytest.MonkeyPatch) -> list[Slow]:
    """All work that was begun beside the frames."""
    monkeypatch.setattr(Slow, "begun", [], raising=False)
    monkeypatch.setattr(room_model, "Beside", Slow)
    return Slow.begun


def session(device: Device, source: SyntheticSource, **more: object) -> ClientSession:
    bounds = default_volume(source, range(30))
    wishes = Wishes(volume_m=bounds, voxel_m=default_voxel(bounds), up=source.up)
    return ClientSession(device, source.camera, msgspec.structs.replace(wishes, **more))


def test_a_live_frame_takes_the_newest_light_that_is_ready(
    device: Device, source: SyntheticSource, begun: list[Slow]
) -> None:
    pipeline = session(device, source)
    lights: list[Floats] = []

    def show(frames: range) -> None:
        lights.extend(np.array(pipeline.process(source[index], turn=Alone()).light.sh) for index in frames)

    show(range(3))
    assert [work.was_waited_for for work in begun] == [True, False], "the first frame has no other light"
    np.testing.assert_array_equal(lights[2], lights[0])

    begun[-1].is_done = True
    show(range(3, 4))
    assert np.abs(lights[3] - lights[2]).max() > 0, "it is taken over by the next frame"
    assert len(begun) == 3, "which begins another"
    pipeline.close()


def test_a_live_frame_waits_in_the_end(device: Device, source: SyntheticSource, begun: list[Slow]) -> None:
    """On a processor that has too much to do the light would never be a new one."""
    pipeline = session(device, source)
    waited: list[bool] = []
    for index in range(2):
        pipeline.process(source[index], turn=Alone())
    begun[-1].age_s = LATEST_S
    for index in range(2, 2 + SOLVE_EVERY):
        pipeline.process(source[index], turn=Alone())
        waited.append(begun[1].was_waited_for)
    assert waited == [False, False, True], "frames may be far apart where many cameras share a device"
    begun[-1].age_s = 0.9 * LATEST_S
    for index in range(6, 16):
        pipeline.process(source[index], turn=Alone())
    assert [work.was_waited_for for work in begun] == [True, True, False]
    pipeline.close()


def test_a_change_of_the_light_is_not_forgotten_meanwhile(
    device: Device, source: SyntheticSource, begun: list[Slow]
) -> None:
    """It moves while a solution is on its way: the next one begins as soon as that is ready."""
    moved = open_source("synthetic:table?frames=30&size=160x120&light=2")
    pipeline = session(device, source)
    shown = 0
    while shown < STEADY or begun[-1].is_done:  # until one has just begun
        for work in begun:
            work.is_done = True
        pipeline.process(source[shown % len(source)], turn=Alone())
        shown += 1
    count = len(begun)
    pipeline.process(moved[shown % len(source)], turn=Alone())
    assert len(begun) == count
    begun[-1].is_done = True
    pipeline.process(moved[(shown + 1) % len(source)], turn=Alone())
    assert len(begun) == count + 1, "long before it would have been its turn"
    pipeline.close()


def test_others_wait_and_have_the_same_light(device: Device, source: SyntheticSource, begun: list[Slow]) -> None:
    """Lossless, or in one process without a camera."""
    alone, lossless = session(device, source), session(device, source, lossless=True)
    for index in range(5):
        expected = alone.process(source[index]).light
        found = lossless.process(source[index], turn=Alone()).light
        assert found.sh == expected.sh
    assert all(work.was_waited_for for work in begun[:-2])
    alone.close()
    lossless.close()
