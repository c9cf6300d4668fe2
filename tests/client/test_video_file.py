"""video.mp4 as a reader finds it: every frame, at its time, in its size and colours."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from client.cli import run_command
from client.errors import OptionError
from client.results.extras import check_extras
from client.results.video_file import VideoFile
from tests.client.results_page import data_of, write_run, write_until

av = pytest.importorskip("av")

WORST_CODES = 6
"""Mean error of flat colours: 4:2:0 and x264 at rate factor 18; measured 1.7."""


def colors(count: int) -> list[tuple[int, int, int]]:
    return [(40 + 10 * i, 200 - 8 * i, 90) for i in range(count)]


def frame(color: tuple[int, int, int], size: tuple[int, int]) -> np.ndarray:
    return np.full((size[1], size[0], 3), color, np.uint8)


@pytest.mark.parametrize("size", [(64, 48), (63, 47)])
def test_every_frame_is_there_at_its_time(size: tuple[int, int], tmp_path: Path) -> None:
    video = VideoFile(tmp_path / "v.mp4", 30.0)
    times_s = [5.0, 5.1, 5.3, 5.3, 5.2, 5.25]  # one stands still, one goes back: a thirtieth each
    for color, time_s in zip(colors(6), times_s, strict=True):
        video.add(frame(color, size), time_s)
    assert video.close()
    with av.open(str(tmp_path / "v.mp4")) as read:
        stream = read.streams.video[0]
        assert (stream.codec_context.name, stream.codec_context.pix_fmt) == ("h264", "yuv420p")
        assert (stream.width, stream.height) == (size[0] + size[0] % 2, size[1] + size[1] % 2)
        pictures = [(picture.time, picture.to_ndarray(format="rgb24")) for picture in read.decode(stream)]
    assert [time for time, _ in pictures] == pytest.approx(
        [0, 0.1, 0.3, 0.3 + 1 / 30, 0.3 + 2 / 30, 0.35 + 2 / 30], abs=1e-3
    )
    for (_, picture), color in zip(pictures, colors(6), strict=True):
        assert np.abs(picture.mean((0, 1)) - color).max() < WORST_CODES


def test_a_constant_rate_is_the_sources(tmp_path: Path) -> None:
    video = VideoFile(tmp_path / "v.mp4", 25.0)
    for i, color in enumerate(colors(10)):
        video.add(frame(color, (64, 48)), i / 25)
    video.close()
    with av.open(str(tmp_path / "v.mp4")) as read:
        stream = read.streams.video[0]
        assert (stream.frames, float(stream.average_rate)) == (10, pytest.approx(25, rel=1e-3))
        assert float(stream.duration * stream.time_base) == pytest.approx(0.4, abs=0.002)


def test_a_run_that_is_interrupted_has_a_whole_video(tmp_path: Path) -> None:
    with pytest.raises(KeyboardInterrupt):
        write_until(tmp_path, KeyboardInterrupt(), video=True)
    with av.open(str(tmp_path / "video.mp4")) as read:
        assert sum(1 for _ in read.decode(read.streams.video[0])) == 3
    assert data_of(tmp_path)["video"] == "video.mp4"


def test_without_a_frame_there_is_no_video(tmp_path: Path) -> None:
    write_run(tmp_path, 0, video=True)
    assert not (tmp_path / "video.mp4").exists()


def test_without_the_extra_one_line_says_what_installs_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("client.results.extras.find_spec", lambda _name: None)
    with pytest.raises(OptionError, match="make install-video, or pip install av"):
        check_extras(True, None)
    assert run_command(["run", "synthetic:table", "--out", str(tmp_path), "--video"]) == 2
    assert capsys.readouterr().err.count("\n") == 1
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("words", [["--video", "h264"], ["--video=h264"], ["--color", "h264"]])
def test_how_colour_is_sent_has_its_earlier_name_too(words: list[str], monkeypatch: pytest.MonkeyPatch) -> None:
    given: list[list[str]] = []

    def note(arguments: list[str], debug: bool) -> int:
        del debug
        given.append(arguments)
        return 0

    monkeypatch.setattr("client.cli.run_command", note)
    monkeypatch.setattr("sys.argv", ["probeless", "stream", "SOURCE", *words, "--lossless"])
    from client.cli import main

    with pytest.raises(SystemExit):
        main()
    assert "h264" in " ".join(given[0])
    assert not any(word.startswith("--video") for word in given[0])


def test_video_is_a_flag_of_its_own(capsys: pytest.CaptureFixture[str]) -> None:
    assert run_command(["stream", "synthetic:table", "--server", "http://127.0.0.1:9", "--video"]) == 2
    assert "go with --out DIR" in capsys.readouterr().err
