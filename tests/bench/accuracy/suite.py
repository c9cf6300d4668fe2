"""`probeless bench accuracy`: what accuracy costs in time (U1), another basis (B9), the thesis's tables (E5).

Every knob is turned on scenes of known truth; points are lines of out/bench/accuracy/points.jsonl. A run that is
stopped goes on with what is missing. The report is one page, out/bench/accuracy/report.html.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Sequence
from importlib import import_module
from pathlib import Path
from typing import Any

from client.errors import OptionError
from server.opencl.device import open_device
from tests.bench.accuracy.budget import budget_part
from tests.bench.accuracy.knobs import points
from tests.bench.accuracy.points import MeasuredPoint
from tests.bench.accuracy.report import write_report
from tests.bench.accuracy.scenes import CLOSED_ROOMS, ESTIMATED, QUICK_SCENES, SCENES
from tests.bench.accuracy.thesis import THESIS_PARTS
from tests.bench.report.finished import CODE, ROOT, Finished, Part, UnmeasurableError, code_digest
from tests.bench.report.report import Report, Row, Unmeasured
from tests.bench.report.run import Run, data_folder
from tests.bench.report.sweep import ENGINES, Engine, Task, run_sweep

OUT = ROOT / "out" / "bench" / "accuracy"
FRAMES, QUICK_FRAMES = 12, 5
_OF_DATA = {"room-key": "mitsuba_room", "room-studio": "mitsuba_room"} | {
    f"closed-{name}": "rooms" for name in CLOSED_ROOMS
}


def run_suite(
    quick: bool,
    say: Callable[[str], None],
    *,
    scenes: str | None = None,
    device: str | None = None,
    out: Path | None = None,
    engine: Engine = "serial",
) -> dict[str, Any]:
    """Measure; `say` gets progress. scenes: names with commas; None, all that can be measured here.

    Raises OptionError for a scene that there is not, SweepError for an engine that cannot be used.
    """
    import_module("matplotlib")  # draws the report at the end; that it is missing shows at once
    folder = out or OUT
    run = Run(open_device(device), quick, say)
    say(f"device: {run.device.name}")
    if engine not in ENGINES:
        raise OptionError(f"--engine {engine}: expected one of {', '.join(ENGINES)}")
    report = Report(run.device.name)
    names = _scenes(scenes, quick, report)
    measured = _sweep(run, names, folder, device, engine)
    _add_points(report, measured)
    parts = _parts(run, folder, report)
    result = report.as_dict()
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "result.json").write_text(json.dumps(result, indent=1, allow_nan=False))
    say(f"report: {write_report(folder, measured, parts, result)}")
    (folder / "unfinished.jsonl").replace(folder / "points.jsonl")
    Finished(folder, run.device.name, quick).forget()
    return result


def _scenes(asked: str | None, quick: bool, report: Report) -> list[str]:
    names = list(QUICK_SCENES if quick else SCENES) if asked is None else [name.strip() for name in asked.split(",")]
    unknown = [name for name in names if name not in SCENES]
    if unknown:
        raise OptionError(f"--scenes {unknown[0]}: there is no such scene; there are: {', '.join(SCENES)}")
    found = []
    for name in names:
        try:
            if name in _OF_DATA:
                data_folder(_OF_DATA[name])
            found.append(name)
        except UnmeasurableError as error:
            report.unmeasured.append(Unmeasured(f"scene {name}", str(error)))
    return found


def _sweep(run: Run, names: Sequence[str], folder: Path, device: str | None, engine: Engine) -> list[MeasuredPoint]:
    frames = run.of(QUICK_FRAMES, FRAMES)
    tasks = [
        Task(scene=name, knob=knob, settings=settings, frames=frames, quick=run.quick, device=device)
        for name in names
        for knob, settings in points(run.quick)
        if name in ESTIMATED or knob != "model"
    ]
    digest = f"{run.device.name} {code_digest(ROOT / part for part in CODE)}"
    key = hashlib.sha256(digest.encode()).hexdigest()[:16]
    return run_sweep(tasks, folder / "unfinished.jsonl", key, run.say, engine)


def _add_points(report: Report, measured: Sequence[MeasuredPoint]) -> None:
    """Medians of every point; what holds and what not is said of the thesis's tables."""
    for point in measured:
        row = f"{point.scene}: {point.words}"
        report.rows.append(Row(f"{row}: frame", _median(point.ms["total"]), "ms", ""))
        report.rows.append(Row(f"{row}: light error", _median(point.direction_deg), "deg", ""))
        report.rows.append(Row(f"{row}: irradiance error", 100 * _median(point.irradiance), "%", ""))
        for name, values in (("FLIP", point.flip), ("SSIM", point.ssim), ("JOD", point.jod)):
            if values:
                report.rows.append(Row(f"{row}: {name}", _median(values), "", ""))
    report.sizes["points"] = len(measured)
    if measured and not any(point.jod for point in measured):
        report.unmeasured.append(Unmeasured("ColorVideoVDP", "not installed: pip install cvvdp"))


def _parts(run: Run, folder: Path, report: Report) -> dict[str, Part]:
    finished = Finished(folder, run.device.name, run.quick)
    found: dict[str, Part] = {}
    for name, part in {**THESIS_PARTS, "budget": budget_part}.items():
        found[name] = finished.part(name, lambda part=part: part(run), run.say)  # type: ignore[misc]
        report.rows += found[name].rows
        report.unmeasured += found[name].unmeasured
        report.sizes |= found[name].sizes
    return found


def _median(values: Sequence[float]) -> float:
    ordered, half = sorted(values), len(values) // 2
    return ordered[half] if len(values) % 2 else (ordered[half - 1] + ordered[half]) / 2
