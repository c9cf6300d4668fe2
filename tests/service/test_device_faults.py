"""A device without memory ends the session that met it, in words that help; the others go on."""

from __future__ import annotations

import pyopencl as cl
import pytest

from protocol.messages import Composite, Error
from tests.service.fakes import FakePipeline, frame_message


@pytest.mark.parametrize("error", [MemoryError(), cl.MemoryError("clCreateBuffer", -4, "no memory")])
def test_a_device_without_memory_is_told(dial, monkeypatch: pytest.MonkeyPatch, error: Exception) -> None:
    good, bad = dial(), dial()
    good.greet()
    bad.greet()
    process = FakePipeline.process

    def failing(pipeline: FakePipeline, frame: object, **wanted: bool) -> object:
        if frame.index == 7:
            raise error
        return process(pipeline, frame, **wanted)

    monkeypatch.setattr(FakePipeline, "process", failing)
    bad.say(frame_message(7))
    code, reason, messages = bad.ending()
    assert code == 1013
    assert reason.startswith("the server's device has no memory left for this session: ask for a larger --voxel")
    assert isinstance(messages[-1], Error)
    good.say(frame_message(1))
    assert good.hear_until(Composite)[-1].frame == 1
