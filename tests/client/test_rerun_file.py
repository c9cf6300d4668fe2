"""`--rerun`: the recording holds every frame with its picture, pose, light and times, read with rerun's own reader."""

from __future__ import annotations

from collections import Counter
from pathlib import Path

import pytest

from client.cli import run_command
from client.errors import OptionError, OutputError
from client.results.extras import check_extras
from client.results.frame_rows import STAGES
from tests.client.results_page import write_run, write_until

COUNT = 3


def test_without_the_extra_one_line_says_what_installs_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("client.results.extras.find_spec", lambda _name: None)
    file = tmp_path / "run.rrd"
    assert run_command(["run", "synthetic:table", "--out", str(tmp_path / "out"), "--rerun", str(file)]) == 2
    told = capsys.readouterr().err
    assert "make install-rerun, or pip install rerun-sdk" in told
    assert told.count("\n") == 1
    assert not list(tmp_path.iterdir())


def test_another_suffix_is_refused() -> None:
    with pytest.raises(OptionError, match=r"ends with \.rrd"):
        check_extras(False, Path("run.bag"))


def test_a_recording_goes_with_a_folder(capsys: pytest.CaptureFixture[str]) -> None:
    assert run_command(["stream", "synthetic:table", "--server", "http://127.0.0.1:9", "--rerun", "x.rrd"]) == 2
    assert "go with --out DIR" in capsys.readouterr().err


def test_every_frame_is_in_the_recording(tmp_path: Path) -> None:
    chunk = pytest.importorskip("rerun.chunk")
    file = tmp_path / "run.rrd"
    write_run(tmp_path / "out", COUNT, rerun=file)
    rows: Counter[str] = Counter()
    frames: dict[str, list[int]] = {}
    for part in chunk.RrdReader(file).stream():
        rows[part.entity_path] += part.num_rows
        if not part.is_static:
            frames.setdefault(part.entity_path, []).extend(part.to_record_batch().column("frame").to_pylist())
    pictures = {f"/world/camera/{name}" for name in ("composite", "captured", "depth")}
    times = {f"/time_ms/{stage}" for stage in (*STAGES, "total")}
    lights = {"/world/light/object_0", "/light/object_0/sh", "/light/beyond/intensity", "/light/object_0/spread_deg"}
    expected = {"/world/camera", "/plan", "/tracking", *pictures, *times, *lights}
    assert expected <= rows.keys()
    assert {name: sorted(frames[name]) for name in expected} == {name: [0, 1, 2] for name in expected}
    assert (rows["/world/scan"], frames["/notes"]) == (1, [1])


def test_it_is_whole_where_a_run_is_interrupted(tmp_path: Path) -> None:
    chunk = pytest.importorskip("rerun.chunk")
    file = tmp_path / "run.rrd"
    with pytest.raises(KeyboardInterrupt):
        write_until(tmp_path / "out", KeyboardInterrupt(), rerun=file)
    parts = [part for part in chunk.RrdReader(file).stream() if part.entity_path == "/world/camera"]
    assert sum(part.num_rows for part in parts) == 3


def test_a_file_that_cannot_be_written_is_told(tmp_path: Path) -> None:
    pytest.importorskip("rerun")
    (tmp_path / "file").write_text("")
    with pytest.raises(OutputError, match="cannot be written"):
        write_run(tmp_path / "out", 1, rerun=tmp_path / "file" / "run.rrd")
