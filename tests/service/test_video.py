"""Colour as video over a real socket: what is read, and what becomes of missing pictures and of readers that die."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import msgspec
import numpy as np
import pytest

pytest.importorskip("av")

from client.commands.stream import Sending
from client.sources.recording import open_recording
from client.streaming.client import ClientError
from client.streaming.coding import Coding
from client.streaming.coding import frame_message as coded_message
from client.streaming.video import VideoEncoder
from protocol.codec import ProtocolError
from protocol.colors import ColorReader
from protocol.h264 import is_key_picture
from protocol.messages import Composite, Dropped, Frame, Hello, Welcome
from protocol.recording import read_messages, write_message
from server.parsing.parsers import VIDEO_JOB, Parsers
from tests.service.fakes import CAMERA, PATIENCE_S, REFUSE_MM, Lab, rgbd_frame
from tests.service.http import rows
from tests.service.proxy import impaired
from tests.service.streaming import FakeSource, quietly
from tests.service.wire import Wire

VIDEO = Sending(adapts=False, video=True)


@pytest.fixture
def parsers() -> Iterator[Parsers]:
    parsers = Parsers()
    yield parsers
    parsers.stop()


def smooth(number: int) -> np.ndarray:
    y, x = np.mgrid[: CAMERA.height, : CAMERA.width]
    return np.stack([5 * x, 7 * y, 3 * (x + y) + 4 * number], axis=-1).astype(np.uint8)


def messages(count: int, keys: tuple[int, ...] = ()) -> list[Frame]:
    """Frames one after the other; key pictures at these numbers, too."""
    video = VideoEncoder()
    sent = []
    for number in range(count):
        if number in keys:
            video.need_key()
        frame = replace(rgbd_frame(number), color=smooth(number))
        sent.append(coded_message(frame, CAMERA, coding=Coding(90), video=video))
    return sent


def sent_frames(record: Path) -> list[Frame]:
    return [message for message in read_messages(record, print) if isinstance(message, Frame)]


def test_a_stream_goes_as_video_and_is_seen_as_it_was(server, lab: Lab, tmp_path: Path) -> None:
    summary = quietly(FakeSource(12), server.url, record=tmp_path / "r", realtime=False, sending=VIDEO)
    assert (summary.sent, summary.answered, summary.dropped) == (12, 12, 0)
    assert {frame.color.codec for frame in sent_frames(tmp_path / "r")} == {"h264"}
    assert [entry[1] for entry in lab.log if entry[0] == "frame"] == list(range(12))


def test_a_server_says_what_it_reads(dial: Callable[[], Wire], monkeypatch: pytest.MonkeyPatch) -> None:
    assert "h264" in dial().greet().codecs
    monkeypatch.setattr("protocol.colors.IS_POSSIBLE", False)
    wire = dial()
    assert wire.greet().codecs == ("jpeg", "png", "raw")
    wire.say(messages(1)[0])
    dropped = wire.hear()
    assert isinstance(dropped, Dropped)
    assert "needs PyAV" in dropped.reason


def test_a_client_is_told_of_a_server_without_it(server, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("protocol.colors.IS_POSSIBLE", False)
    with pytest.raises(ClientError, match=r"reads no H\.264 .* leave out --color"):
        quietly(FakeSource(2), server.url, sending=VIDEO)


def test_a_replaced_picture_costs_those_that_rest_on_it(dial: Callable[[], Wire], lab: Lab) -> None:
    lab.hold = True
    wire = dial()
    wire.greet()
    sent = messages(8, keys=(6,))
    wire.say(sent[0])
    assert lab.next_entered() == 0
    wire.say(*sent[1:5])
    replaced = [wire.hear() for _ in range(3)]
    assert [(answer.frame, answer.reason) for answer in replaced] == [
        (n, "replaced by a newer frame") for n in (1, 2, 3)
    ]
    lab.release(8)
    wire.hear_until(Composite)
    missing = wire.hear()
    assert isinstance(missing, Dropped)
    assert missing.frame == 4
    assert "send a key picture" in missing.reason
    wire.say(sent[6], sent[7])
    assert [wire.hear_until(Composite)[-1].frame for _ in range(2)] == [6, 7]


def test_a_client_sends_a_key_picture_after_one_that_was_dropped(server, tmp_path: Path) -> None:
    """Frame 3 is refused for its depth, and its colour has been read all the same."""
    source = FakeSource(30, depths_mm={3: REFUSE_MM})
    summary = quietly(source, server.url, record=tmp_path / "r", realtime=False, sending=VIDEO)
    assert summary.dropped == 1
    assert summary.answered == summary.sent - 1
    colors = [frame.color for frame in sent_frames(tmp_path / "r")]
    assert is_key_picture(colors[0].data)
    assert [is_key_picture(color.data) for color in colors[4:7]].count(True) == 1
    assert not any(is_key_picture(color.data) for color in colors[7:])


def test_a_key_picture_comes_after_a_lost_connection(server, lab: Lab, tmp_path: Path) -> None:
    with impaired(server.url) as proxy:

        class Cutting(FakeSource):
            def __getitem__(self, index: int):
                if index == 20:
                    proxy.cut()
                return super().__getitem__(index)

        summary = quietly(Cutting(40), proxy.url, record=tmp_path / "r", realtime=False, sending=VIDEO)
    assert summary.answered >= 40 - 4
    assert summary.answered + summary.dropped == 40
    assert [entry[1] for entry in lab.log if entry[0] == "frame"][-1] == 39


def test_a_reader_that_dies_is_told_and_followed_by_another(start_server: Callable) -> None:
    parsers = Parsers()
    server = start_server(parsers=parsers)
    wire = Wire(server.url)
    wire.greet()
    sent = messages(5, keys=(3,))
    wire.say(sent[0])
    wire.hear_until(Composite)
    (children,) = parsers._videos
    os.kill(children.pids[0], signal.SIGKILL)
    wire.say(sent[1])
    told = wire.hear()
    assert isinstance(told, Dropped)
    wire.say(sent[2])
    missing = wire.hear()
    assert isinstance(missing, Dropped)
    assert "send a key picture" in missing.reason
    wire.say(sent[3], sent[4])
    assert [wire.hear_until(Composite)[-1].frame for _ in range(2)] == [3, 4]
    assert ("probeless_parser_deaths_total", "video") in rows(server)
    pid = children.pids[0]
    wire.hang_up()
    until_s = time.monotonic() + PATIENCE_S
    while Path(f"/proc/{pid}").exists() and time.monotonic() < until_s:
        time.sleep(0.02)
    assert not Path(f"/proc/{pid}").exists()  # with its session
    assert not parsers._videos


def test_readers_start_no_threads_and_have_limits(parsers: Parsers) -> None:
    reader = parsers.color_reader(CAMERA)
    for message in messages(3):
        assert np.abs(reader.decode(message.color).astype(int) - smooth(message.frame)).mean() < 4
    (children,) = parsers._videos
    assert len(list(Path(f"/proc/{children.pids[0]}/task").iterdir())) == 1
    limits = Path(f"/proc/{children.pids[0]}/limits").read_text()
    assert str(VIDEO_JOB.memory_mib << 20) in limits
    reader.close()
    assert not parsers._videos


def test_no_thread_is_needed_to_read_a_picture() -> None:
    """Where none can be started: for any user but root, who is no subject of the limit, a reader would die of it."""
    program = """
import os
from protocol.video import VideoDecoder
from server.children.child import limit
from tests.service.test_video import messages
decoder, message = VideoDecoder(), messages(1)[0]
if os.getuid() == 0:
    os.setuid(65534)
limit(1024)
print(decoder.decode(message.color.data).shape)
"""
    run = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=False)
    assert (run.returncode, run.stdout.split()[:1]) == (0, ["(32,"]), run.stderr[-500:]


def test_a_reader_and_this_process_read_the_same(parsers: Parsers) -> None:
    there, here = parsers.color_reader(CAMERA), ColorReader(CAMERA)
    for message in messages(6, keys=(4,)):
        np.testing.assert_array_equal(there.decode(message.color), here.decode(message.color))
    there.close()


def test_sessions_have_a_reader_each(parsers: Parsers) -> None:
    one, other = parsers.color_reader(CAMERA), parsers.color_reader(CAMERA)
    first, second = messages(2)
    one.decode(first.color)
    with pytest.raises(ProtocolError, match="send a key picture"):
        other.decode(second.color)
    one.decode(second.color)
    one.close()
    other.close()


def test_a_recording_with_video_is_read_forwards_and_anywhere(server, tmp_path: Path) -> None:
    quietly(FakeSource(10), server.url, record=tmp_path / "r", realtime=False, sending=VIDEO)
    source = open_recording(tmp_path / "r")
    assert len(source) == 10
    forwards = [source[place].color for place in range(10)]
    for place in (9, 0, 4, 4, 5, 2):
        np.testing.assert_array_equal(source[place].color, forwards[place])
    for place, color in enumerate(forwards):
        grey, seen = (picture.astype(float) @ (0.299, 0.587, 0.114) for picture in (color, rgbd_frame(place).color))
        assert np.abs(grey - seen).mean() < 10  # the colour of noise is what 4:2:0 leaves out
        np.testing.assert_array_equal(source[place].depth, rgbd_frame(place).depth)


def test_frames_of_a_recording_that_rest_on_none_are_left_out(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    sent = messages(8, keys=(5,))
    with (tmp_path / "r").open("wb") as file:
        write_message(file, Hello(client="test", camera=CAMERA))
        for message in (*sent[:2], *sent[3:]):
            write_message(file, message)
    source = open_recording(tmp_path / "r")
    assert [round(source[place].timestamp_s, 6) for place in range(len(source))] == [
        round(sent[number].timestamp_s, 6) for number in (0, 1, 5, 6, 7)
    ]
    assert "2 frames of video rest on pictures that were not sent" in capsys.readouterr().err


def test_replay_gives_the_same_pictures(start_server: Callable, tmp_path: Path) -> None:
    """What was sent is sent again to another server, message by message."""
    first, second = start_server(), start_server()
    quietly(FakeSource(6), first.url, record=tmp_path / "r", realtime=False, sending=VIDEO)
    recorded = list(read_messages(tmp_path / "r", print))
    pictures = {m.frame: m.color.data for m in recorded if isinstance(m, Composite)}
    wire = Wire(second.url)
    wire.say(next(m for m in recorded if isinstance(m, Hello)))
    assert isinstance(wire.hear(), Welcome)
    for message in recorded:
        if isinstance(message, Frame):
            wire.say(message)
            again = wire.hear_until(Composite)[-1]
            assert again.color.data == pictures[again.frame]
    wire.hang_up()


def test_linear_and_lossless_sessions_stay_as_they_are(server, tmp_path: Path) -> None:
    quietly(FakeSource(3), server.url, record=tmp_path / "r", lossless=True, sending=VIDEO)
    assert {frame.color.codec for frame in sent_frames(tmp_path / "r")} == {"raw"}
    linear = msgspec.structs.replace(CAMERA, color_encoding="linear16")
    wide = replace(rgbd_frame(0), color=rgbd_frame(0).color.astype(np.uint16))
    assert coded_message(wide, linear, video=VideoEncoder()).color.codec == "raw"
