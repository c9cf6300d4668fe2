"""`probeless bench speed`: what a frame costs, with what is kept at places of the world and without.

Each frame goes to every setting before the next one does, so that load of the machine meets all alike. Milliseconds are
of the machine that the page names; two cores are meant.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from typing import Any

from server.opencl.device import open_device
from tests.bench.report.finished import ROOT, Finished, Part
from tests.bench.report.report import Report
from tests.bench.report.run import Run, data_folder, data_source
from tests.bench.speed.devices import measure_devices
from tests.bench.speed.frames import Stage, measure_moving, measure_rest
from tests.bench.speed.memory import measure_memory

OUT = ROOT / "out" / "bench" / "speed"
KITCHEN = "rgbd_7scenes_redkitchen"
ON_TABLE_M = (-0.6, 0.0, 1.8)
"""Where the kitchen's table is free."""
OBJECT, OBJECT_SCALE = "mesh/Duck.glb", 0.1


def run_suite(quick: bool, say: Callable[[str], None]) -> dict[str, Any]:
    """Measure; `say` gets progress."""
    run = Run(open_device(None), quick, say)
    OUT.mkdir(parents=True, exist_ok=True)
    finished = Finished(OUT, run.device.name, quick)
    report = Report(run.device.name)
    parts = {"moving camera": _moving, "camera at rest": _rest, "memory": _memory, "devices": _devices}
    for name, measure in parts.items():
        part = finished.part(name, lambda measure=measure: measure(run), say)  # type: ignore[misc]
        report.rows += part.rows
        report.unmeasured += part.unmeasured
        report.sizes |= part.sizes
    result = report.as_dict()
    (OUT / "result.json").write_text(json.dumps(result, indent=1, allow_nan=False))
    finished.forget()
    return result


def kitchen_stage() -> Stage:
    """The real kitchen, a duck on its table. Raises UnmeasurableError where it is not."""
    return Stage(data_source(KITCHEN), data_folder(OBJECT), ON_TABLE_M, OBJECT_SCALE)


def _moving(run: Run) -> Part:
    return measure_moving(run.device, kitchen_stage(), range(run.of(24, 200)), run.say)


def _rest(run: Run) -> Part:
    return measure_rest(run.device, kitchen_stage(), 100, run.of(72, 120), run.say)


def _memory(run: Run) -> Part:
    return measure_memory(run.device, data_folder(OBJECT), run.of(40, 1000), run.say)


def _devices(run: Run) -> Part:
    return measure_devices(run.device, kitchen_stage(), range(run.of(16, 60)), run.say)
