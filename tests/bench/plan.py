"""`probeless bench plan`: does each frame run what its scene calls for, and is what is left out not seen (U3).

Every scene of the gallery (client/laptop/gallery) goes through the pipeline twice: as planned, and with everything
simulated that can be. Time is processor time over all cores, which other load distorts least.
"""

from __future__ import annotations

import json
import time
from collections.abc import Callable
from contextlib import closing
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from statistics import median
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from client.laptop.gallery.play import play, wishes_of
from client.laptop.gallery.scenes import GALLERY
from client.laptop.gallery.source import GallerySource
from protocol.messages import Plan
from server.evaluation.flip import flip_map
from server.evaluation.report import Report, Row, Unmeasured
from server.opencl.device import Device, open_device
from tests.bench.rendering_speed import EVERYTHING as WHOLE_STAGE
from tests.bench.rendering_speed import StageClock, clocked

OUT = Path("out/bench/plan")
WARM_UP = 2
"""Frames whose time does not count: kernels are compiled in them."""


@dataclass(frozen=True)
class Played:
    """One frame, played one way."""

    color: NDArray[np.uint8]
    plan: Plan
    cpu_ms: float
    rendering_ms: float


def run_suite(quick: bool, say: Callable[[str], None]) -> dict[str, Any]:
    """Measure; `say` gets progress."""
    device = open_device(None)
    report = Report(device.name)
    saved: list[float] = []
    rendering_saved: list[float] = []
    OUT.mkdir(parents=True, exist_ok=True)
    rounds = 1 if quick else 3
    for name in GALLERY:
        say(name)
        source = GallerySource(name)
        pairs = [(played(device, source, "needed"), played(device, source, "everything")) for _ in range(rounds)]
        needed, everything = pairs[0]
        _compare(report, name, source, needed, everything)
        saved.append(_saved(pairs, lambda frame: frame.cpu_ms))
        rendering_saved.append(_saved(pairs, lambda frame: frame.rendering_ms))
        report.rows.append(Row(f"{name}: time saved, of the whole frame", 100 * saved[-1], "%", ""))
        report.rows.append(Row(f"{name}: time saved, of rendering", 100 * rendering_saved[-1], "%", ""))
        cv2.imwrite(str(OUT / f"{name}.png"), needed[-1].color[..., ::-1])
    report.rows.append(Row("gallery: time saved, of the whole frame, median", 100 * median(saved), "%", ">= 40"))
    report.rows.append(Row("gallery: time saved, of rendering, median", 100 * median(rendering_saved), "%", ""))
    report.rows.append(Row("gallery: scenes", len(GALLERY), "", ">= 12"))
    report.sizes["rounds"] = rounds
    report.sizes["frames of the gallery"] = sum(len(GallerySource(name)) for name in GALLERY)
    if find_spec("flip_evaluator") is None:
        report.unmeasured.append(Unmeasured("FLIP", "flip_evaluator not installed: make install-bench"))
    result = report.as_dict()
    (OUT / "result.json").write_text(json.dumps(result, indent=1, allow_nan=False))
    return result


def played(device: Device, source: GallerySource, plan: str) -> list[Played]:
    """Every frame of a scene."""
    frames: list[Played] = []
    with closing(play(device, source, wishes_of(source, plan=plan))) as results:
        clock = None
        pipeline = None
        for _ in range(len(source)):
            if pipeline is None:
                started = time.process_time()
                pipeline, result = next(results)
                clock = StageClock(pipeline._engine.queue)
                rendering_ms = 0.0
            else:
                assert clock is not None
                with clocked(pipeline, clock):
                    started = time.process_time()
                    _, result = next(results)
                rendering_ms = clock.cpu_ms[WHOLE_STAGE][-1]
            cpu_ms = (time.process_time() - started) * 1e3
            frames.append(Played(result.color, result.plan, cpu_ms, rendering_ms))
    return frames


def is_as_known(source: GallerySource, index: int, plan: Plan) -> bool:
    """Whether a frame ran what its scene calls for, and the light was estimated where it had to be."""
    rests_from = source.scene.rests_from
    rests = any(left.effect == "estimate_light" for left in plan.left_out)
    is_known_to = rests_from is not None and index >= rests_from
    return frozenset(plan.run) == source.scene.calls_for(index) and rests == is_known_to


def stated_bound(plan: Plan, reference: Plan) -> float:
    """Display units before rounding that what is left out here alone may change; equal reasons count once."""
    neither = {left.effect for left in reference.left_out}
    omissions = {(left.reason, left.error_bound) for left in plan.left_out if left.effect not in neither}
    return sum(bound or 0.0 for _, bound in omissions)


def holds(bound: float, difference: int) -> bool:
    """Whether pictures that differ by so many codes can be within `bound` before rounding, which adds less than 1."""
    return difference == 0 if bound == 0 else difference < bound + 1


def _compare(report: Report, name: str, source: GallerySource, needed: list[Played], everything: list[Played]) -> None:
    differences = [np.abs(a.color.astype(int) - b.color) for a, b in zip(needed, everything, strict=True)]
    bounds = [stated_bound(a.plan, b.plan) for a, b in zip(needed, everything, strict=True)]
    as_known = [is_as_known(source, i, a.plan) for i, a in enumerate(needed)]
    kept = [holds(bound, int(d.max())) for bound, d in zip(bounds, differences, strict=True)]
    within = min(float((d.max(axis=-1) <= 1).mean()) for d in differences)
    report.rows.append(Row(f"{name}: frames whose plan is the known one", float(np.mean(as_known)), "share", ">= 1"))
    report.rows.append(Row(f"{name}: pixels within 1/255, worst frame", within, "share", ">= 0.999"))
    report.rows.append(Row(f"{name}: frames whose bounds hold", float(np.mean(kept)), "share", ">= 1"))
    report.rows.append(Row(f"{name}: greatest difference", max(int(d.max()) for d in differences), "1/255", ""))
    report.rows.append(Row(f"{name}: greatest bound", max(bounds), "1/255", ""))
    if find_spec("flip_evaluator") is not None:
        flips = [float(flip_map(b.color, a.color).mean()) for a, b in zip(needed, everything, strict=True)]
        report.rows.append(Row(f"{name}: FLIP, worst frame", max(flips), "", "<= 0.005"))


def _saved(pairs: list[tuple[list[Played], list[Played]]], spent: Callable[[Played], float]) -> float:
    """Share of everything's time that the plan saves: of each frame the median over rounds, summed over frames."""
    totals = []
    for which in (0, 1):
        rounds = [pair[which] for pair in pairs]
        totals.append(sum(median(spent(played[i]) for played in rounds) for i in range(WARM_UP, len(rounds[0]))))
    return 1 - totals[0] / totals[1]
