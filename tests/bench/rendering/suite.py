"""`probeless bench rendering`: composites against a path tracer's, shadows of what left the picture, and what it costs.

Data sets are found through PROBELESS_DATA; a part whose data or peer is absent is named as not measured. A run that is
stopped goes on with the parts that are missing: finished ones lie in out/bench/rendering/parts. The pictures and
report.html, which shows them beside the figures, lie in out/bench/rendering.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from functools import partial
from importlib import import_module
from importlib.util import find_spec
from itertools import product
from typing import Any

from server.opencl.device import open_device
from tests.bench.rendering.common import OUT
from tests.bench.rendering.pictures import stack
from tests.bench.rendering.report import write_report
from tests.bench.rendering.room import LIGHTS, SURFACES, room_part
from tests.bench.rendering.speed import speed_part
from tests.bench.rendering.stage import stage_part
from tests.bench.rendering.turning import turning_part
from tests.bench.report.finished import Finished, Part
from tests.bench.report.report import Report
from tests.bench.report.run import Run

RASTERIZE = ("tests.bench.rendering.rasterize", "rasterize_part")
"""The rasteriser beside Open3D's ray cast: a module and its function."""
SHEETS = {"presets": "presets.jpg", "bounce": "bounce.jpg"}
"""Of the strips whose names begin so: the thesis's fig. 7.11 and 7.10."""


def rasterize_part(run: Run) -> Part:
    """What the rasteriser's own module measures; without one, a note that there is none."""
    module, name = RASTERIZE
    if find_spec(module) is None:
        missing = Part()
        missing.leave_out("rasteriser beside Open3D", f"there is no {module} yet")
        return missing
    measured: Part = getattr(import_module(module), name)(run)
    return measured


PARTS: dict[str, Callable[[Run], Part]] = {
    **{
        f"{light} {surface}": partial(room_part, light=light, surface=surface)
        for light, surface in product(LIGHTS, SURFACES)
    },
    "stage": stage_part,
    "turning": turning_part,
    "speed": speed_part,
    "rasterize": rasterize_part,
}


def run_suite(quick: bool, say: Callable[[str], None]) -> dict[str, Any]:
    """Measure; `say` gets progress."""
    run = Run(open_device(None), quick, say)
    say(f"device: {run.device.name}")
    finished = Finished(OUT, run.device.name, quick)
    report = Report(run.device.name)
    for name, measure in PARTS.items():
        part = finished.part(name, lambda measure=measure: measure(run), say)  # type: ignore[misc]
        report.rows += part.rows
        report.unmeasured += part.unmeasured
        report.sizes |= part.sizes
    for first_word, file in SHEETS.items():
        stack(OUT, first_word, OUT / file)
    result = report.as_dict()
    OUT.mkdir(parents=True, exist_ok=True)
    (OUT / "result.json").write_text(json.dumps(result, indent=1, allow_nan=False))
    say(f"pictures and figures: {write_report(OUT, result)}")
    finished.forget()
    return result
