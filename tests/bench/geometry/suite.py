"""`probeless bench geometry`: this program and its peers side by side, and what the geometry half is held to.

Data sets are found through PROBELESS_DATA; a part whose data or peer is absent is named as not measured. A run that is
stopped goes on with the parts that are missing: finished ones lie in out/bench/geometry/parts. Pictures: beside them.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from typing import Any

from server.opencl.device import open_device
from tests.bench.geometry.parts import (
    OUT,
    filters,
    hand,
    interleaving_part,
    memory_part,
    noise_part,
    pictures,
    speed_part,
    surface_part,
    trajectory_part,
)
from tests.bench.geometry.pictures import draw_times
from tests.bench.report.finished import Finished, Part
from tests.bench.report.report import Report
from tests.bench.report.run import Run

PARTS: dict[str, Callable[[Run], Part]] = {
    "speed": speed_part,
    "filters": filters,
    "trajectory": trajectory_part,
    "surface": surface_part,
    "noise": noise_part,
    "hand": hand,
    "memory": memory_part,
    "interleaving": interleaving_part,
    "pictures": pictures,
}


def run_suite(quick: bool, say: Callable[[str], None]) -> dict[str, Any]:
    """Measure; `say` gets progress."""
    run = Run(open_device(None), quick, say)
    say(f"device: {run.device.name}")
    finished = Finished(OUT, run.device.name, quick)
    report = Report(run.device.name)
    details = {}
    for name, measure in PARTS.items():
        part = finished.part(name, lambda measure=measure: measure(run), say)  # type: ignore[misc]
        report.rows += part.rows
        report.unmeasured += part.unmeasured
        report.sizes |= part.sizes
        details[name] = part.details
    times_ms = details["speed"].get("wall_ms")
    if times_ms:
        draw_times(OUT / "times.png", times_ms, report.sizes["frames timed"])
    result = report.as_dict()
    (OUT / "result.json").write_text(json.dumps(result, indent=1, allow_nan=False))
    finished.forget()
    return result
