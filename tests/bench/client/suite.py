"""`probeless bench client`: what a thin client's frames take on the way up, what sparing them costs, how old they get.

Of 7-Scenes' kitchen, 640x480, and of stereo depth like an OAK-D's, made from a synthetic room; bits at 15 frames/s. A
run that was stopped goes on with the parts that are missing: finished ones lie in out/bench/client/parts.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from functools import partial
from typing import Any

from server.opencl.device import open_device
from tests.bench.client.bandwidth import bandwidth_part, cost_part
from tests.bench.client.browser import browser_part
from tests.bench.client.latency import LINKS, latency_part
from tests.bench.client.layer import layer_screen_part, layer_wire_part
from tests.bench.client.video import video_part
from tests.bench.report.finished import ROOT, Finished, Part
from tests.bench.report.report import Report
from tests.bench.report.run import Run

OUT = ROOT / "out" / "bench" / "client"
PARTS: dict[str, Callable[..., Part]] = {
    "bandwidth": bandwidth_part,
    "cost": cost_part,
    "video": video_part,
    **{f"latency, {name}": partial(latency_part, name) for name in LINKS},
    "browser": browser_part,
    "layers on the wire": layer_wire_part,
    "layers on the screen": layer_screen_part,
}


def run_suite(quick: bool, say: Callable[[str], None]) -> dict[str, Any]:
    """Measure; `say` gets progress."""
    run = Run(open_device(None), quick, say)
    OUT.mkdir(parents=True, exist_ok=True)
    finished = Finished(OUT, run.device.name, quick)
    report = Report(run.device.name)
    for name, measure in PARTS.items():
        part = finished.part(name, lambda measure=measure: measure(run, OUT), say)  # type: ignore[misc]
        report.rows += part.rows
        report.unmeasured += part.unmeasured
        report.sizes |= part.sizes
    result = report.as_dict()
    (OUT / "result.json").write_text(json.dumps(result, indent=1, allow_nan=False))
    finished.forget()
    return result
