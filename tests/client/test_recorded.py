"""A recording as a source."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from client.errors import SourceError
from client.options.source import open_source
from protocol.frames import CameraModel
from protocol.images import encode_color, encode_depth
from protocol.messages import Bye, Frame, Hello, Welcome, Wishes
from protocol.recording import write_message
from tests.client import folders

CAMERA = CameraModel(width=32, height=24, fx=30, fy=31, cx=15.5, cy=11.5, depth_scale_m=0.0005)


def record(path: Path, numbers: range = range(3), posed: bool = True) -> Path:
    with path.open("wb") as file:
        write_message(file, Hello(client="test", camera=CAMERA, wishes=Wishes(up=(0.0, 1.0, 0.0))))
        write_message(file, Welcome(session="1", server="test", device="none", max_inflight=2))
        for i in numbers:
            pose = tuple(folders.pose_of(i).ravel().tolist()) if posed else None
            color, depth = encode_color(folders.color_of(i), "raw"), encode_depth(folders.depth_of(i))
            write_message(
                file, Frame(frame=100 + i, timestamp_s=5 + i / 20, world_from_camera=pose, color=color, depth=depth)
            )
        write_message(file, Bye())
    return path


def test_frames_come_back_exactly(tmp_path: Path) -> None:
    source = open_source(str(record(tmp_path / "a.rec")))
    assert (len(source), source.name, source.camera, source.up) == (3, "a.rec", CAMERA, (0.0, 1.0, 0.0))
    assert source.has_poses
    assert source.fps == pytest.approx(20)
    for index in (2, 0, 1, -1):
        frame = source[index]
        number = index % 3
        assert frame.index == number  # the position here, not the one in the source that was recorded
        assert frame.timestamp_s == 5 + number / 20
        np.testing.assert_array_equal(frame.color, folders.color_of(number))
        np.testing.assert_array_equal(frame.depth, folders.depth_of(number))
        np.testing.assert_array_equal(frame.world_from_camera, folders.pose_of(number))


def test_exposures_come_back(tmp_path: Path) -> None:
    """One that cannot be is for the pipeline to tell of."""
    path = record(tmp_path / "a.rec")
    with path.open("ab") as file:
        for number, exposure in enumerate((0.02, 0.04, float("nan"))):
            color, depth = encode_color(folders.color_of(0), "raw"), encode_depth(folders.depth_of(0))
            more = {"world_from_camera": None, "color": color, "depth": depth, "exposure": exposure}
            write_message(file, Frame(frame=200 + number, timestamp_s=6 + number / 20, **more))
    source = open_source(str(path))
    assert [source[i].exposure for i in range(5)] == [None, None, None, 0.02, 0.04]
    assert np.isnan(source[5].exposure)


def test_without_poses(tmp_path: Path) -> None:
    source = open_source(str(record(tmp_path / "a.rec", posed=False)))
    assert not source.has_poses
    assert source[0].world_from_camera is None


def test_interrupted_recording_keeps_its_whole_frames(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = record(tmp_path / "a.rec")
    path.write_bytes(path.read_bytes()[:-200])
    assert len(open_source(str(path))) == 2
    assert "ends inside a message" in capsys.readouterr().err


@pytest.mark.parametrize("content", [b"", b"hello, I am text", bytes(range(256)), b"\x93\x01\x02\x03"])
def test_file_that_is_no_recording(content: bytes, tmp_path: Path) -> None:
    path = tmp_path / "a.rec"
    path.write_bytes(content)
    with pytest.raises(SourceError, match=r"a\.rec") as caught:
        open_source(str(path))
    assert "\n" not in str(caught.value)


def test_recording_of_nothing(tmp_path: Path) -> None:
    with pytest.raises(SourceError, match="no captured frames"):
        open_source(str(record(tmp_path / "a.rec", range(0))))


def test_wrong_picture_inside_is_named(tmp_path: Path) -> None:
    path = record(tmp_path / "a.rec")
    data = path.read_bytes().replace(b"srgb8", b"srgb9", 2)
    path.write_bytes(data)
    with pytest.raises(SourceError, match=r"a\.rec"):
        open_source(str(path))[0]
