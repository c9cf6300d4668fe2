"""Recordings: what is written comes back, a cut file gives what is whole, and anything else is refused in a line."""

from __future__ import annotations

from pathlib import Path

import msgpack
import pytest

from protocol.codec import ProtocolError, encode
from protocol.limits import MAX_MESSAGE_BYTES
from protocol.messages import ColorImage, Frame
from protocol.recording import read_messages, write_message
from tests.protocol.samples import CLIENT, DEPTH, SERVER

ALL = [*CLIENT.values(), *SERVER.values()]


def _no_report(line: str) -> None:
    raise AssertionError(f"reported: {line}")


@pytest.fixture
def recording(tmp_path: Path) -> Path:
    path = tmp_path / "kitchen.rec"
    with path.open("wb") as file:
        for message in ALL:
            write_message(file, message)
    return path


def test_what_was_written_comes_back_in_order(recording: Path) -> None:
    assert list(read_messages(recording, _no_report)) == ALL


def test_appending_is_concatenation(recording: Path) -> None:
    with recording.open("ab") as file:
        write_message(file, CLIENT["frame"])
    assert list(read_messages(recording, _no_report)) == [*ALL, CLIENT["frame"]]
    assert recording.read_bytes() == b"".join(map(encode, [*ALL, CLIENT["frame"]]))


def test_an_independent_reader_sees_the_same_stream(recording: Path) -> None:
    with recording.open("rb") as file:
        tags = [message["type"] for message in msgpack.Unpacker(file)]
    assert tags == [type(message).__struct_config__.tag for message in ALL]


@pytest.mark.parametrize("cut", [1, 5, 20])
def test_a_truncated_last_message_is_reported_after_the_whole_ones(recording: Path, cut: int) -> None:
    whole = recording.read_bytes()
    start = len(whole) - len(encode(ALL[-1]))
    recording.write_bytes(whole[:-cut])
    reports: list[str] = []
    assert list(read_messages(recording, reports.append)) == ALL[:-1]
    (line,) = reports
    assert "truncated" in line
    assert f"from byte {start}" in line


def test_empty_recording(tmp_path: Path) -> None:
    path = tmp_path / "empty.rec"
    path.touch()
    assert list(read_messages(path, _no_report)) == []


def test_large_messages_pass_and_too_large_ones_do_not(tmp_path: Path) -> None:
    color = ColorImage(width=10, height=10, codec="raw", data=bytes(MAX_MESSAGE_BYTES - 4096))
    large = Frame(frame=1, timestamp_s=0.0, world_from_camera=None, color=color, depth=DEPTH)
    path = tmp_path / "large.rec"
    path.write_bytes(encode(large) * 3)
    assert [message == large for message in read_messages(path, _no_report)] == [True] * 3
    path.write_bytes(msgpack.packb({"type": "bye", "reason": "x" * (MAX_MESSAGE_BYTES + 1)}))
    with pytest.raises(ProtocolError, match="byte 0"):
        list(read_messages(path, _no_report))


@pytest.mark.parametrize(
    "rubbish",
    [
        b"\xc1",
        b"\x07",
        b"\xff\xd8\xff\xe0",
        b"\x91" * 100_000,
        b"\x81\xa1\xff\xc0",
        msgpack.packb({1: 2}),
        msgpack.packb({"type": "bye", "reason": 5}),
        msgpack.packb({"type": "bye", "reason": msgpack.Timestamp(1)}),
        msgpack.packb({"type": "light"}),
    ],
)
def test_what_is_no_message_is_refused_with_its_position(recording: Path, rubbish: bytes) -> None:
    start = recording.stat().st_size
    with recording.open("ab") as file:
        file.write(rubbish)
    messages = read_messages(recording, _no_report)
    assert [next(messages) for _ in ALL] == ALL
    with pytest.raises(ProtocolError, match=f"byte {start}") as refusal:
        next(messages)
    assert str(refusal.value).isprintable()
