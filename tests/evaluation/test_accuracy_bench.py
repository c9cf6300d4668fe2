"""The sweep of `bench accuracy`: points, what they are measured by, and that a stopped run goes on."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from client.commands.bench import run_bench
from client.errors import OptionError
from protocol.messages import Wishes
from server.opencl.device import Device
from server.quality.settings import read_wishes
from tests.bench.accuracy import scenes as accuracy_scenes
from tests.bench.accuracy.knobs import KNOBS, points
from tests.bench.accuracy.points import MeasuredPoint, measure_point, words_of
from tests.bench.report import sweep
from tests.bench.report.sweep import SweepError, Task, run_sweep
from tests.data import data_folder


def point(task: Task, total_ms: float = 10.0) -> MeasuredPoint:
    lists = {name: [1.0, 2.0] for name in ("direction_deg", "irradiance", "msad", "flip", "ssim", "jod", "cpu_ms")}
    return MeasuredPoint(
        scene=task.scene,
        knob=task.knob,
        settings=task.settings,
        words=words_of(task.settings),
        frames=[2, 3],
        ms={"total": [total_ms, total_ms]},
        device_bytes=1,
        **lists,
    )


def tasks(count: int) -> list[Task]:
    return [Task(scene="stage", knob="rays", settings={"rays": 16 + i}, frames=4, quick=True) for i in range(count)]


def test_every_point_is_a_session_that_can_be() -> None:
    swept = list(points(quick=False))
    assert len(swept) == len({json.dumps(settings, sort_keys=True) for _, settings in swept})
    for _, settings in swept:
        read_wishes(Wishes(**settings))
    assert {knob for knob, _ in swept} == {"usual", *KNOBS}
    assert 8 <= len(list(points(quick=True))) < len(swept) / 2


def test_a_stopped_sweep_goes_on(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """What was measured is not measured again, a line that was cut off is, another key's too."""
    measured: list[str] = []

    def measure(task: Task) -> MeasuredPoint:
        measured.append(task.identity)
        if len(measured) == 4:
            raise KeyboardInterrupt
        return point(task)

    monkeypatch.setattr(sweep, "measure", measure)
    path = tmp_path / "points.jsonl"
    with pytest.raises(KeyboardInterrupt):
        run_sweep(tasks(6), path, "a", lambda _: None)
    assert len(path.read_text().splitlines()) == 3
    path.write_text(path.read_text()[:-20])
    said: list[str] = []
    found = run_sweep(tasks(6), path, "a", said.append)
    assert [p.settings["rays"] for p in found] == [16, 17, 18, 19, 20, 21]
    assert len(measured) == 4 + 4  # the one that was cut off, the one that was stopped and two
    assert "2 of 6 points were measured before" in said[0]
    assert "6/6 stage: --rays 21" in said[-1]
    run_sweep(tasks(6), path, "b", lambda _: None)
    assert len(measured) == 8 + 6


def test_ray_that_is_not_there_is_said(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(__import__("sys").modules, "ray", None)
    with pytest.raises(SweepError, match="pip install ray"):
        run_sweep(tasks(1), tmp_path / "points.jsonl", "a", lambda _: None, "ray")


def test_a_point_of_the_stage(device: Device, monkeypatch: pytest.MonkeyPatch) -> None:
    """More rays err less, and everything that is measured is there and finite."""
    monkeypatch.setattr(accuracy_scenes, "_STAGE_FRAMES", 8)
    scene = accuracy_scenes._stage("stage", "texture=paper&light=7", "160x120", albedo="constant", indirect="none")
    few, many = (measure_point(device, scene, "rays", {"rays": rays}, 4) for rays in (4, 169))
    assert few.words == "--rays 4"
    assert few.frames == [4, 6]
    for name in ("direction_deg", "irradiance", "msad", "ssim", "cpu_ms"):
        assert len(getattr(many, name)) == 2
        assert np.isfinite(getattr(many, name)).all()
    assert len(many.ms["total"]) == 2
    assert many.device_bytes > 1 << 20
    assert np.mean(many.irradiance) < np.mean(few.irradiance)


def test_what_only_some_suites_take_is_refused_by_the_others() -> None:
    with pytest.raises(OptionError, match="--scenes: bench plan has no such option"):
        run_bench("plan", as_json=False, quick=True, options={"scenes": "stage", "out": None})


def test_a_point_of_a_closed_room_is_judged_at_its_places(device: Device) -> None:
    """Against what is rendered there: a light from beyond the scan says little in a room."""
    data_folder("rooms")
    scene = accuracy_scenes.scene_named("closed-r1_ceiling", device, quick=True)
    assert len(scene.wishes.light_at) == 3
    found = measure_point(device, scene, "usual", {}, 6)
    assert found.frames == [4, 6, 8, 10]
    assert len(found.direction_deg) == len(found.irradiance) == 4
    assert np.mean(found.direction_deg) < 20  # seen: 6; the sky's, 85
    assert len(found.ssim) == 1  # every fifth frame has a true picture, every second is shown
