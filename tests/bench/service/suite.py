"""`probeless bench service`: what makes it a service a person would run for others.

The way of one client; load; frames of minutes; attacks; faults at random moments; bad bytes; two clients that see a
plane each; replay. Servers are processes of their own, as in the field; clients run here, on the same cores. A run that
was stopped goes on with the parts that are missing: finished ones lie in out/bench/service/parts, mutated messages in
bytes.jsonl, logs beside them.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from functools import partial
from typing import Any

from server.opencl.device import open_device
from tests.bench.report.finished import ROOT, Finished, Part
from tests.bench.report.report import Report
from tests.bench.report.run import Run
from tests.bench.service.attacks import large_models_part, silent_sockets_part
from tests.bench.service.bytes import decoder_part, socket_part
from tests.bench.service.faults import FAULTS, fault_part, server_killed_part
from tests.bench.service.floods import floods_part
from tests.bench.service.full_disk import full_disk_part
from tests.bench.service.http import http_part, schema_part
from tests.bench.service.load import load_part, side_by_side_part
from tests.bench.service.long_frames import long_frames_part
from tests.bench.service.odd_numbers import odd_numbers_part
from tests.bench.service.planes import planes_part
from tests.bench.service.replay import replay_part
from tests.bench.service.speed import speed_part

OUT = ROOT / "out" / "bench" / "service"
PARTS: dict[str, Callable[..., Part]] = {
    "speed": speed_part,
    "load": load_part,
    "side by side": side_by_side_part,
    "long frames": long_frames_part,
    "silent sockets": silent_sockets_part,
    "large models": large_models_part,
    "floods": floods_part,
    "server killed": server_killed_part,
    "disk full, then killed": full_disk_part,
    **{name: partial(fault_part, name) for name in FAULTS},
    "odd numbers": odd_numbers_part,
    "mutated messages": decoder_part,
    "mutated messages over the socket": socket_part,
    "bad requests": http_part,
    "requests by the schema": schema_part,
    "two planes": planes_part,
    "replay": replay_part,
}


def run_suite(quick: bool, say: Callable[[str], None]) -> dict[str, Any]:
    """Measure; `say` gets progress."""
    run = Run(open_device(None), quick, say)
    say(f"device: {run.device.name}")
    OUT.mkdir(parents=True, exist_ok=True)
    finished = Finished(OUT, run.device.name, quick)
    report = Report(run.device.name)
    details: dict[str, Any] = {}
    for name, measure in PARTS.items():
        part = finished.part(name, lambda measure=measure: measure(run, OUT), say)  # type: ignore[misc]
        report.rows += part.rows
        report.unmeasured += part.unmeasured
        report.sizes |= part.sizes
        details[name] = part.details
    result = report.as_dict()
    (OUT / "result.json").write_text(json.dumps(result, indent=1, allow_nan=False))
    (OUT / "details.json").write_text(json.dumps(details, indent=1, allow_nan=False))
    finished.forget()
    (OUT / "bytes.jsonl").unlink(missing_ok=True)
    return result
