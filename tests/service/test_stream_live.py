"""`stream` of a camera: ends by Ctrl-C or --frames, always its newest frame, a recording that can be streamed again."""

import os
import signal
from pathlib import Path

import pytest

from client.sources.frame_source import ENDLESS
from client.sources.recording import open_recording
from protocol.frames import RgbdFrame
from tests.service.streaming import FakeSource, quietly


class Camera(FakeSource):
    """Every other frame is missed; Ctrl-C comes after one of them."""

    def __init__(self, interrupted_at: int = ENDLESS) -> None:
        super().__init__(ENDLESS)
        self.interrupted_at, self.missed = interrupted_at, 0

    def __getitem__(self, index: int) -> RgbdFrame:
        self.missed += 1
        if index == self.interrupted_at:
            os.kill(os.getpid(), signal.SIGINT)
        return super().__getitem__(index)


@pytest.mark.parametrize("lossless", [False, True])
def test_a_camera_streams_until_ctrl_c_and_ends_in_order(server, lossless: bool, tmp_path: Path) -> None:
    before = signal.getsignal(signal.SIGINT)
    summary = quietly(Camera(interrupted_at=5), server.url, lossless=lossless, record=tmp_path / "camera.rec")
    assert (summary.sent, summary.answered, summary.skipped, summary.dropped) == (6, 6, 6, 0)
    recorded = open_recording(tmp_path / "camera.rec")
    assert [recorded[i].index for i in range(len(recorded))] == list(range(6))
    assert signal.getsignal(signal.SIGINT) is before


def test_a_camera_ends_with_the_last_frame_asked_for(server) -> None:
    summary = quietly(Camera(), server.url, frames=range(7, 11))
    assert (summary.sent, summary.answered) == (4, 4)
