"""`stream`: a source over a real socket into a folder, at its own rate or losslessly."""

import io
import threading
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
from rich.console import Console

from client.cli import run_command
from client.commands import stream as streaming
from client.commands.stream import stream
from client.display.stream_statistics import StreamStatistics
from client.errors import ObjectError, OutputError, SourceError
from client.objects.object_file import ObjectFile
from client.results.description import describe
from client.results.frame_output import FrameOutput, captured_of
from client.results.output_folder import OutputWriter
from client.streaming.adaptive import Adaptive
from client.streaming.client import ClientError, RoomPlace
from protocol.frames import RgbdFrame
from protocol.messages import Bye, Composite, Frame, Hello, Light, PlaceObject, Welcome
from protocol.recording import read_messages
from tests.service.fakes import EXPLODE_MM, REFUSE_MM, fake_result, rgbd_frame
from tests.service.streaming import FakeSource, files, quietly

TRIANGLE_OBJ = "v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n"


def run_in_process(source: FakeSource, frames: range, folder: Path) -> None:
    """What the pipeline makes of the frames without a network."""
    with OutputWriter(folder, describe(source, len(frames), ())) as writer:
        writer.note_device("a fake device")
        for i in frames:
            frame = source[i]
            result = {**vars(fake_result(frame))}
            assert result.pop("layer") is None  # not wished for
            assert result.pop("placed") == ()  # files have it as a note
            result["captured"] = captured_of(frame, source.camera)
            writer.write(FrameOutput(frame=frame.index, timestamp_s=frame.timestamp_s, **result))


def test_lossless_stream_writes_the_bytes_of_an_in_process_run(server, tmp_path: Path) -> None:
    source, frames = FakeSource(12), range(2, 12, 3)
    run_in_process(source, frames, tmp_path / "run")
    summary = quietly(source, server.url, out=tmp_path / "stream", lossless=True, frames=frames)
    assert files(tmp_path / "stream") == files(tmp_path / "run")
    assert sorted(files(tmp_path / "run"))[3:6] == ["camera/000011.jpg", "frames/000002.png", "frames/000005.png"]
    assert (summary.sent, summary.answered, summary.skipped, summary.dropped) == (4, 4, 0, 0)
    assert (summary.device, summary.session) == ("a fake device", "session-1")


def test_stream_writes_jpeg_quality_pictures_and_exact_numbers(server, tmp_path: Path) -> None:
    source = FakeSource(3)
    run_in_process(source, range(3), tmp_path / "run")
    quietly(source, server.url, out=tmp_path / "stream", realtime=False)
    ours, theirs = files(tmp_path / "stream"), files(tmp_path / "run")
    assert ours.keys() == theirs.keys()
    for name in ("light.jsonl", "trajectory.txt", "timings.jsonl"):
        assert ours[name] == theirs[name]
    picture = cv2.imread(str(tmp_path / "stream" / "frames" / "000001.png"), cv2.IMREAD_COLOR_RGB)
    assert np.abs(picture.mean((0, 1)) - (255 - rgbd_frame(1).color).mean((0, 1))).max() < 3


def test_an_answer_is_shown_before_it_is_written(server, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """One after the other, in their order; a slow disk does not make pictures late."""
    events: list[tuple[str, int]] = []
    note, write = StreamStatistics.note_answer, OutputWriter.write

    def noted(self: StreamStatistics, number: int, *times: float) -> None:
        events.append(("shown", number))
        note(self, number, *times)

    def written(self: OutputWriter, output: FrameOutput) -> None:
        events.append(("begun", output.frame))
        write(self, output)
        events.append(("written", output.frame))

    monkeypatch.setattr(StreamStatistics, "note_answer", noted)
    monkeypatch.setattr(OutputWriter, "write", written)
    quietly(FakeSource(6), server.url, out=tmp_path, realtime=False)
    assert [what for what in events if what[0] != "shown"] == [
        (what, number) for number in range(6) for what in ("begun", "written")
    ]
    for number in range(6):
        assert events.index(("shown", number)) < events.index(("begun", number))


@pytest.mark.parametrize("number", [2, 5])
def test_a_disk_that_refuses_ends_the_stream(
    server, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, number: int
) -> None:
    """The last frame too, which nothing comes after."""
    write = OutputWriter.write

    def refused(self: OutputWriter, output: FrameOutput) -> None:
        if output.frame == number:
            raise OutputError("the disk is full")
        write(self, output)

    monkeypatch.setattr(OutputWriter, "write", refused)
    with pytest.raises(OutputError, match="the disk is full"):
        quietly(FakeSource(6), server.url, out=tmp_path, realtime=False)
    assert "frames/000001.png" in files(tmp_path)


def test_a_frame_is_prepared_while_the_server_computes_the_last(server, monkeypatch: pytest.MonkeyPatch) -> None:
    """Reading and encoding take their time: the next frame is begun by so much before the server is expected to end."""
    read_s, leads_s = 0.05, []
    may_send = Adaptive.may_send

    class SlowSource(FakeSource):
        def __getitem__(self, index: int) -> RgbdFrame:
            time.sleep(read_s)
            return super().__getitem__(index)

    def asked(self: Adaptive, sent_s: float, last_sent_s: float, unanswered: int) -> bool:
        leads_s.append(sent_s - time.perf_counter())
        return may_send(self, sent_s, last_sent_s, unanswered)

    monkeypatch.setattr(Adaptive, "may_send", asked)
    for _ in range(5):  # a busy machine skips all but two of the frames, and learns from none
        quietly(SlowSource(12, fps=15.0), server.url)
        if max(leads_s) > 0.8 * read_s:
            break
    assert leads_s[0] < 0.5 * read_s
    assert max(leads_s) > 0.8 * read_s


def test_without_realtime_every_frame_is_answered(server) -> None:
    summary = quietly(FakeSource(30), server.url, realtime=False)
    assert (summary.sent, summary.answered, summary.skipped, summary.dropped) == (30, 30, 0, 0)


def test_the_command_loses_no_frame_of_a_folder_while_the_server_is_busy(server, lab, capsys) -> None:
    lab.hold = True
    releasing = threading.Timer(0.5, lambda: lab.release(12))  # long after the source's 12 frames have passed
    releasing.start()
    assert run_command(["stream", "synthetic:table?frames=12", "--server", server.url]) == 0
    assert "12 frames answered" in capsys.readouterr().out


def test_the_command_keeps_the_rate_where_it_is_asked_to(server, lab, capsys, monkeypatch) -> None:
    """The server is busy until a frame was skipped."""
    lab.hold = True
    advance = streaming._Stream._advance

    def released(self: streaming._Stream) -> None:
        if self._summary.skipped == 1:
            lab.release(12)
        advance(self)

    monkeypatch.setattr(streaming._Stream, "_advance", released)
    assert run_command(["stream", "synthetic:table?frames=12", "--server", server.url, "--realtime"]) == 0
    assert ", 0 skipped" not in capsys.readouterr().out


def test_realtime_skips_frames_while_the_server_is_busy(server, lab, monkeypatch) -> None:
    lab.hold, total = True, 20
    skips: list[int] = []
    advance = streaming._Stream._advance

    def count(self: streaming._Stream) -> None:
        advance(self)
        skips.append(self._summary.skipped)
        if self._summary.skipped == total - 2:
            lab.release(2)

    monkeypatch.setattr(streaming._Stream, "_advance", count)
    summary = quietly(FakeSource(total), server.url)
    assert (summary.sent, summary.answered, summary.skipped) == (2, 2, total - 2)
    assert skips[0] == 1


def test_realtime_keeps_the_frame_rate(server) -> None:
    summary = quietly(FakeSource(11, fps=50.0), server.url)
    assert summary.seconds >= 10 / 50
    assert summary.sent + summary.skipped == 11


def test_refused_frames_are_told_and_the_rest_goes_on(server) -> None:
    console = Console(file=io.StringIO(), width=200)
    summary = stream(FakeSource(5, depths_mm={2: REFUSE_MM}), server.url, realtime=False, console=console)
    assert (summary.answered, summary.dropped) == (4, 1)
    assert "frame 2: no depth in this frame: point the camera at something" in console.file.getvalue()


def test_refused_frame_ends_a_lossless_stream_as_it_ends_a_run(server) -> None:
    with pytest.raises(ClientError, match="frame 2: no depth in this frame"):
        quietly(FakeSource(5, depths_mm={2: REFUSE_MM}), server.url, lossless=True)


@pytest.mark.parametrize("lossless", [False, True])
def test_failing_server_ends_the_stream_in_one_line(server, lossless) -> None:
    with pytest.raises(ClientError, match="the server failed in this session"):
        quietly(FakeSource(50, depths_mm={1: EXPLODE_MM}), server.url, lossless=lossless)


def test_damaged_source_ends_the_stream_after_its_good_frames(server, tmp_path: Path) -> None:
    with pytest.raises(SourceError, match="frame 2: the picture is truncated"):
        quietly(FakeSource(5, depths_mm={2: 0}), server.url, out=tmp_path, realtime=False)
    assert {"frames/000000.png", "frames/000001.png"} < files(tmp_path).keys()


def test_an_object_that_the_server_could_not_save_is_there_and_it_is_said(start_server, lab, triangle: Path) -> None:
    server = start_server(room_factory=lambda _wishes, name: SimpleNamespace(name=name, key_digest=None, close=print))
    service, console = server.service, Console(file=io.StringIO(), width=400)
    service._worker_context = replace(service._worker_context, save_room=lambda _name: "the disk is full")
    objects = [ObjectFile(triangle, (1.0, 2.0, 3.0))]
    summary = stream(FakeSource(1), server.url, objects, console=console, realtime=False, room=RoomPlace("study"))
    assert summary.answered == 1
    assert [entry[0] for entry in lab.log] == ["place", "frame"]
    assert "triangle.obj: not saved: the disk is full; it is done, and lost if" in console.file.getvalue()


@pytest.fixture
def triangle(tmp_path: Path) -> Path:
    path = tmp_path / "triangle.obj"
    path.write_text(TRIANGLE_OBJ)
    return path


def test_objects_are_placed_before_the_first_frame(server, lab, triangle: Path) -> None:
    objects = [ObjectFile(triangle, (1.0, 2.0, 3.0), 0.5, 90.0), ObjectFile(triangle, None)]
    console = Console(file=io.StringIO(), width=200)
    stream(FakeSource(1), server.url, objects, console=console, realtime=False)
    assert [(entry[0], entry[1]) for entry in lab.log] == [("place", "object-0"), ("place", "object-1"), ("frame", 0)]
    assert lab.log[0][2] == ("obj", TRIANGLE_OBJ.encode())
    placement = lab.log[0][3]
    assert (placement.position_m, placement.scale, placement.yaw_deg) == ((1.0, 2.0, 3.0), 0.5, 90.0)
    assert lab.log[1][3].position_m is None
    assert "triangle.obj: object-0 has no texture" in console.file.getvalue()


def test_bad_object_is_told_before_anything_is_sent(server, lab, tmp_path: Path) -> None:
    (tmp_path / "junk.obj").write_text("hello")
    with pytest.raises(ObjectError, match=r"junk\.obj"):
        quietly(FakeSource(1), server.url, [ObjectFile(tmp_path / "junk.obj", None)])
    assert not lab.threads


def test_object_the_server_refuses_is_told(start_server, triangle: Path) -> None:
    def load(*_: object) -> None:
        raise ValueError("the object has no area")

    server = start_server(mesh_loader=load)
    with pytest.raises(ClientError, match=r"triangle\.obj: the object has no area"):
        quietly(FakeSource(1), server.url, [ObjectFile(triangle, None)])


def test_recording_has_every_message_of_both_directions(server, tmp_path: Path, triangle: Path) -> None:
    path = tmp_path / "kept" / "session.probeless"
    quietly(FakeSource(3), server.url, [ObjectFile(triangle, None)], lossless=True, record=path)
    messages = list(_recorded(path))
    kinds = [type(message) for message in messages]
    assert kinds[:2] == [Hello, Welcome]
    assert kinds[2] is PlaceObject
    assert kinds[4:] == [Frame, Light, Composite] * 3 + [Bye]
    assert [m.frame for m in messages if isinstance(m, Composite)] == [0, 1, 2]


def _recorded(path: Path) -> Iterator:
    def report(line: str) -> None:
        raise AssertionError(line)

    return read_messages(path, report)


def test_recording_that_cannot_be_written_is_told(server, tmp_path: Path) -> None:
    with pytest.raises(OutputError, match="--record"):
        quietly(FakeSource(1), server.url, record=tmp_path)
