"""`probeless bench light`: the light found in scenes whose light is known, and what finding it costs.

Data sets are found through PROBELESS_DATA; a part whose data or peer is absent is named as not measured. A run that is
stopped goes on with the parts that are missing: finished ones lie in out/bench/light/parts. Pictures: beside them.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from typing import Any

import numpy as np

from server.opencl.device import open_device
from tests.bench.light.e1 import SEQUENCES, overall_part
from tests.bench.light.parts import KITCHEN, OUT, PARTS, ROOM
from tests.bench.light.pictures import draw_alone, draw_e1, draw_rooms
from tests.bench.light.room import THESIS
from tests.bench.light.runs import PRESETS, REFERENCE
from tests.bench.light.speed import errors_beside
from tests.bench.report.finished import Finished, Part
from tests.bench.report.report import Report
from tests.bench.report.run import Run


def run_suite(quick: bool, say: Callable[[str], None]) -> dict[str, Any]:
    """Measure; `say` gets progress."""
    run = Run(open_device(None), quick, say)
    say(f"device: {run.device.name}")
    finished = Finished(OUT, run.device.name, quick)
    report = Report(run.device.name)
    details: dict[str, dict[str, Any]] = {}
    for name, measure in PARTS.items():
        part = finished.part(name, lambda measure=measure: measure(run), say)  # type: ignore[misc]
        _take(report, part)
        details[name] = part.details
    e1 = {sequence.name: details[sequence.name] for sequence in SEQUENCES}
    _take(report, overall_part(e1))
    _take(report, errors_beside(e1))
    _draw(details, e1)
    result = report.as_dict()
    OUT.mkdir(parents=True, exist_ok=True)
    (OUT / "result.json").write_text(json.dumps(result, indent=1, allow_nan=False))
    finished.forget()
    return result


def _take(report: Report, part: Part) -> None:
    report.rows += part.rows
    report.unmeasured += part.unmeasured
    report.sizes |= part.sizes


def _draw(details: dict[str, dict[str, Any]], e1: dict[str, dict[str, Any]]) -> None:
    """As fig. 5.4: a picture for each data set whose part was measured."""
    draw_rooms(OUT, details[ROOM], (*PRESETS, THESIS))
    draw_e1(OUT / "e1.png", e1, REFERENCE)
    if details[KITCHEN]:
        light, up, view = (np.array(details[KITCHEN][key]) for key in ("light", "up", "view"))
        draw_alone(OUT / "kitchen.png", "red kitchen, estimated", light, up, view)
