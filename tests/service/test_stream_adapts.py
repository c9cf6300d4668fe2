"""Adaptive sending over a real socket and a link that carries little."""

from pathlib import Path

from client.commands.stream import Sending
from protocol.limits import MOST_INFLIGHT
from protocol.messages import Composite, Frame
from protocol.recording import read_messages
from tests.service.proxy import impaired
from tests.service.streaming import FakeSource, quietly

BYTES_PER_S = 60_000
"""A frame at full quality takes about 5 kB: twelve a second, of sixty."""


def sent_frames(record: Path) -> list[Frame]:
    return [message for message in read_messages(record, print) if isinstance(message, Frame)]


def test_a_slow_link_gets_smaller_pictures_and_exact_depth(server, tmp_path: Path) -> None:
    source = FakeSource(180, fps=60.0)
    with impaired(server.url, delay_s=0.01, bytes_per_s=BYTES_PER_S) as link:
        summary = quietly(source, link.url, record=tmp_path / "r")
    frames = sent_frames(tmp_path / "r")
    assert (summary.sent, summary.answered) == (len(frames), len(frames))
    assert summary.skipped == 180 - len(frames) > 0
    assert len(frames[-1].color.data) < 0.6 * len(frames[0].color.data)
    assert frames[-1].color.width < frames[0].color.width == source.camera.width
    assert all(frame.depth.rounded_per_m is None for frame in frames)
    assert summary.latency_ms["whole"][0] > 1e3 * len(frames[-1].depth.data) / BYTES_PER_S


def test_what_is_fixed_stays_as_it_is(server, tmp_path: Path) -> None:
    with impaired(server.url, bytes_per_s=BYTES_PER_S) as link:
        fixed = Sending(adapts=False, depth_noise_per_m=0.003)
        quietly(FakeSource(30, fps=30.0), link.url, record=tmp_path / "r", sending=fixed)
    frames = sent_frames(tmp_path / "r")
    assert {frame.color.width for frame in frames} == {48}
    assert {frame.depth.rounded_per_m for frame in frames} == {0.003}


def test_over_a_far_link_more_frames_are_under_way_than_two(server, tmp_path: Path) -> None:
    with impaired(server.url, delay_s=0.15) as link:
        summary = quietly(FakeSource(60, fps=20.0), link.url, record=tmp_path / "r")
    assert summary.answered == summary.sent > 0
    under_way, most = 0, 0
    for message in read_messages(tmp_path / "r", print):
        under_way += isinstance(message, Frame) - isinstance(message, Composite)
        most = max(most, under_way)
    assert 2 < most <= MOST_INFLIGHT
