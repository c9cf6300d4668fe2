"""`probeless bench client`: what the laptop client's frames take on the way up, what sparing them costs, their age.

Of 7-Scenes' kitchen, 640x480, and of stereo depth like an OAK-D's, made from a synthetic room; bits at 15 frames/s.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from server.evaluation.report import Report, Unmeasured
from server.opencl.device import open_device
from tests.bench.client_bandwidth import KITCHEN, bandwidth_rows, cost_rows
from tests.bench.client_latency import latency_rows

FRAMES, QUICK_FRAMES = {"bandwidth": 40, "cost": 20, "latency": 3000}, {"bandwidth": 10, "cost": 6, "latency": 600}


def run_suite(quick: bool, say: Callable[[str], None]) -> dict[str, Any]:
    """Measure; `say` gets progress."""
    sizes = QUICK_FRAMES if quick else FRAMES
    device = open_device(None)
    report = Report(device.name, sizes={f"frames of {name}": count for name, count in sizes.items()})
    if not KITCHEN.is_dir():
        report.unmeasured.append(Unmeasured("all of it", f"no data at {KITCHEN}"))
        return report.as_dict()
    report.rows += bandwidth_rows(sizes["bandwidth"], say)
    report.rows += cost_rows(device, sizes["cost"], say)
    report.rows += latency_rows(sizes["latency"], say)
    reason = "the server does not say when a frame arrived; waiting and both ways are one figure"
    report.unmeasured.append(Unmeasured("latency: received and returned apart", reason))
    return report.as_dict()
