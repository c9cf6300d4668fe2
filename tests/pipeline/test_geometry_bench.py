"""The benchmark of geometry: whose times count, what the ratios are, and that a stopped run goes on."""

from __future__ import annotations

import os
import time
from importlib import import_module
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from client.sources.volume import default_volume
from client.synthetic.source import open_synthetic
from protocol.frames import CameraModel, RgbdFrame
from server.tracking import camera_tracking
from tests.bench.geometry.filters import energy
from tests.bench.geometry.surface import SurfaceView
from tests.bench.peers import contestant
from tests.bench.peers.contest import ENTRIES, GRIDS, OURS, OURS_TRACKING, WARM_UP, Score, contest_part, fault
from tests.bench.peers.contestant import FILTER, INTEGRATE, RAYCAST, TRACK, Scene, Turn
from tests.bench.peers.worker import ContestantLostError, Entry, Worker
from tests.bench.report import finished as finished_module
from tests.bench.report.drawing import COLORS, bars, difference_picture, side_by_side
from tests.bench.report.finished import Finished, Part, UnmeasurableError
from tests.bench.report.report import Row, Unmeasured

TRUTH = np.tile(np.eye(4), (WARM_UP + 3, 1, 1))


def turns(**ms: float) -> list[Turn]:
    """Slow ones first, then three at `ms` and twice that."""
    times = [{name.replace("_", " "): factor * value for name, value in ms.items()} for factor in (1, 2, 2)]
    return [Turn({INTEGRATE: 1e6}, {INTEGRATE: 1e6})] * WARM_UP + [Turn(item, dict(item)) for item in times]


def scores(**lost: str) -> dict[str, Score]:
    result = {entry.name: Score(lost="not here") for entry in ENTRIES}
    result[OURS] = Score(turns(integrate=10, ray_cast=20))
    result[OURS_TRACKING] = Score(turns(track=9, filter_before_tracking=3))
    result[GRIDS[0]] = Score(turns(integrate=20, ray_cast=80), lost=lost.get("grid8", ""))
    result[GRIDS[1]] = Score(turns(integrate=30, ray_cast=90), lost=lost.get("grid16", ""))
    return result


def values(part: Part) -> dict[str, Row]:
    return {row.name: row for row in part.rows}


def test_ratios_are_against_the_faster_grid() -> None:
    rows = values(contest_part(scores(), 0.01, TRUTH))
    assert rows[f"{OURS}: {INTEGRATE}, median"].value == 20
    assert rows[f"{OURS}: {INTEGRATE}, minimum"].value == 10
    ratio = rows[f"{INTEGRATE} + {RAYCAST}, {OURS} / Open3D VoxelBlockGrid {INTEGRATE} + {RAYCAST}"]
    assert ratio.value == pytest.approx(0.3)
    assert ratio.holds
    track = rows[f"{TRACK}, {OURS} / Open3D VoxelBlockGrid {INTEGRATE} + {RAYCAST}"]
    assert track.value == pytest.approx(0.09)
    assert track.goal == "<= 0.18"
    filtered = rows[f"{FILTER} + {TRACK}, {OURS} / Open3D VoxelBlockGrid {INTEGRATE} + {RAYCAST}"]
    assert filtered.value == pytest.approx(0.12)
    assert not filtered.goal
    slower = values(contest_part(scores(grid8="its surface is empty"), 0.01, TRUTH))
    assert slower[ratio.name].value == pytest.approx(0.25)


def test_without_a_peer_there_is_no_ratio_but_a_reason() -> None:
    part = contest_part(scores(grid8="open3d is not installed", grid16="open3d is not installed"), 0.01, TRUTH)
    assert not [name for name in values(part) if "/" in name]
    ratios = [item for item in part.unmeasured if "/" in item.name]
    assert len(ratios) == 3
    assert {item.reason for item in ratios} == {"open3d is not installed"}
    assert Unmeasured(GRIDS[0], "open3d is not installed") in part.unmeasured


def test_an_empty_or_misplaced_surface_does_not_count() -> None:
    def view(depth_m: float, share: float) -> SurfaceView:
        depth = np.where(np.arange(100) < 100 * share, depth_m, 0).reshape(10, 10)
        return SurfaceView(depth, np.ones((10, 10)), np.ones((10, 10), bool))

    assert fault([], 0.01) == ""
    assert fault([view(1.005, 0.9)], 0.01) == ""
    assert "covers 0%" in fault([view(1.0, 0.0)], 0.01)
    assert "covers 30%" in fault([view(1.0, 0.3)], 0.01)
    assert "2.00 voxels off" in fault([view(1.02, 1.0)], 0.01)


class Hands:
    """Clocks that are set by hand, in place of the module time."""

    def __init__(self) -> None:
        self.wall_s, self.cpu_s = 5.0, 3.0

    def perf_counter(self) -> float:
        return self.wall_s

    def process_time(self) -> float:
        return self.cpu_s

    def work(self, wall_s: float, cpu_s: float) -> None:
        self.wall_s, self.cpu_s = self.wall_s + wall_s, self.cpu_s + cpu_s


def test_what_is_left_out_does_not_count(monkeypatch: pytest.MonkeyPatch) -> None:
    hands, turn = Hands(), Turn()
    monkeypatch.setattr(contestant, "time", hands)
    with turn.clock(TRACK):
        hands.work(0.010, 0.015)
        with turn.clock(FILTER), turn.without(TRACK):
            hands.work(0.050, 0.090)
    assert turn.wall_ms == pytest.approx({TRACK: 10, FILTER: 50})
    assert turn.cpu_ms == pytest.approx({TRACK: 15, FILTER: 90})


def test_a_package_that_is_absent_is_named() -> None:
    assert Entry("x", "tests.bench", "X", "no_such_package").absence() == (
        "no_such_package is not installed: make install-bench"
    )
    assert Entry("x", "tests.bench", "X", "numpy").absence() is None
    assert Entry("x", "tests.bench", "X", kind="TPU").absence() == "no usable OpenCL TPU here"


class Contestant:
    """Ends its process at the third frame, fails at the second; says its scene's voxel size as depth."""

    def __init__(self, scene: Scene) -> None:
        self.voxel_m = scene.voxel_m

    def process(self, frame: RgbdFrame, turn: Turn) -> None:
        if frame.index == 2:
            os._exit(7)
        if frame.index == 1:
            raise ValueError("cannot take this one")
        with turn.clock(INTEGRATE):
            time.sleep(0.02)

    def depth(self, frame: RgbdFrame) -> NDArray[np.float32]:
        return np.full(frame.depth.shape, self.voxel_m, np.float32)


def test_a_contestant_has_a_process_of_its_own() -> None:
    camera = CameraModel(width=8, height=8, fx=8.0, fy=8.0, cx=4.0, cy=4.0)
    frames = [RgbdFrame(i, 0.0, np.zeros((8, 8, 3), np.uint8), np.zeros((8, 8), np.uint16), None) for i in range(3)]
    scene = Scene(camera, (0, 0, 0, 1, 1, 1), 0.25, np.eye(4))
    with Worker(Entry("x", "tests.pipeline.test_geometry_bench", "Contestant"), scene) as worker:
        turn = worker.process(frames[0])
        assert turn.wall_ms[INTEGRATE] > 19
        assert list(turn.cpu_ms) == [INTEGRATE]
        assert (worker.depth(frames[0]) == 0.25).all()
        with pytest.raises(ContestantLostError, match="ValueError: cannot take this one"):
            worker.process(frames[1])
        with pytest.raises(ContestantLostError, match="status 7"):
            worker.process(frames[2])
    with pytest.raises(ContestantLostError, match="no attribute 'Nobody'"):
        _ = Worker(Entry("x", "tests.pipeline.test_geometry_bench", "Nobody"), scene).process(frames[0])


@pytest.mark.parametrize("entry", [entry for entry in ENTRIES if entry.name in (OURS, OURS_TRACKING)])
def test_our_own_contestants_play(entry: Entry, monkeypatch: pytest.MonkeyPatch) -> None:
    """Each frame has times of what it is measured for."""
    monkeypatch.setattr(camera_tracking, "bilateral_depth", camera_tracking.bilateral_depth)  # one puts a clock there
    source = open_synthetic("synthetic:table?size=160x120")
    bounds_m = default_volume(source, range(3))
    start = source[0].world_from_camera
    assert start is not None
    contestant = getattr(import_module(entry.module), entry.attribute)(Scene(source.camera, bounds_m, 0.01, start))
    for index in range(3):
        turn = Turn()
        contestant.process(source[index], turn)
        wanted = {INTEGRATE, RAYCAST} if entry.name == OURS else {TRACK}
        assert wanted <= set(turn.wall_ms)
        assert min(turn.wall_ms[name] for name in wanted) > 0
        if entry.name == OURS:
            assert np.isfinite(contestant.depth(source[index])).any()


def test_differences_show_their_side() -> None:
    exact = np.full((2, 3), 1.0)
    depth = np.array([[0.98, 1.0, 1.02], [0.0, 0.99, 5.0]])
    red, white, blue = (0, 0, 255), (255, 255, 255), (255, 0, 0)
    expected = [[red, white, blue], [(128, 128, 128), (127, 127, 255), blue]]
    np.testing.assert_array_equal(difference_picture(depth, exact, 0.02), expected)
    assert difference_picture(np.ones((1, 1)), np.zeros((1, 1)), 0.02).tolist() == [[[128, 128, 128]]]


def test_bars_are_as_long_as_their_times() -> None:
    picture = bars("times", {"a": {INTEGRATE: 10.0, RAYCAST: 30.0}, "b": {TRACK: 20.0}})
    pieces = ((0, INTEGRATE), (0, RAYCAST), (1, TRACK))
    lengths = [(picture[54 + 34 * row] == COLORS[action]).all(axis=-1).sum() for row, action in pieces]
    np.testing.assert_allclose(lengths, (160, 480, 320), atol=2)
    assert side_by_side([(name, picture) for name in "xyz"]).shape == (
        2 * (28 + picture.shape[0]),
        2 * picture.shape[1],
        3,
    )


def test_energy_counts_jumps_and_differences() -> None:
    step = np.zeros((6, 8), np.uint8)
    step[:, 5:] = 51
    assert energy(step, step) == pytest.approx(4 * 0.2)  # 4 of 6 rows are looked at
    assert energy(np.zeros_like(step), step) == pytest.approx(4 * 3 * 0.2)


def test_a_stopped_run_goes_on(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    said: list[str] = []
    calls: list[str] = []

    def measure() -> Part:
        calls.append("measured")
        part = Part(sizes={"frames": 3})
        part.add("a", 2.0, "ms", "<= 3")
        part.add("b", float("inf"), "ms")
        return part

    first = Finished(tmp_path, "device", quick=True).part("one part", measure, said.append)
    again = Finished(tmp_path, "device", quick=True).part("one part", measure, said.append)
    assert calls == ["measured"]
    assert again == first
    assert again.rows == [Row("a", 2.0, "ms", "<= 3")]
    assert again.unmeasured == [Unmeasured("b", "the figure is not finite")]
    for other in (Finished(tmp_path, "device", quick=False), Finished(tmp_path, "other device", quick=True)):
        other.part("one part", measure, said.append)
    assert len(calls) == 3
    monkeypatch.setattr(finished_module, "code_digest", lambda _: "changed")
    changed = Finished(tmp_path, "other device", quick=True)
    changed.part("one part", measure, said.append)
    assert len(calls) == 4
    changed.forget()
    assert not list(tmp_path.iterdir())


def test_what_cannot_be_measured_is_said(tmp_path: Path) -> None:
    def measure() -> Part:
        raise UnmeasurableError("no such data")

    part = Finished(tmp_path, "device", quick=True).part("hands", measure, lambda _: None)
    assert not part.rows
    assert part.unmeasured == [Unmeasured("hands", "no such data")]


def test_half_a_file_is_measured_again(tmp_path: Path) -> None:
    kept = Finished(tmp_path, "device", quick=True)
    kept.part("x", Part, lambda _: None)
    file = next(tmp_path.rglob("*.json"))
    file.write_text(file.read_text()[:20])
    assert kept.part("x", lambda: Part(sizes={"n": 1}), lambda _: None).sizes == {"n": 1}


def test_code_digest_sees_every_change(tmp_path: Path) -> None:
    (tmp_path / "a.py").write_text("x = 1")
    before = finished_module.code_digest([tmp_path])
    (tmp_path / "b.cl").write_text("kernel")
    between = finished_module.code_digest([tmp_path])
    (tmp_path / "a.py").write_text("x = 2")
    assert len({before, between, finished_module.code_digest([tmp_path])}) == 3
