"""Budgets on the living room: are frames in time, and is the light as good as the best point that fits (U1)?

The device's front is measured first, as `probeless tune` does, and kept beside the benchmark's figures. Each of its
points then runs the same frames by itself: it fits a budget if it keeps it as well as a budget is held to be kept.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from statistics import fmean, median

import numpy as np
from msgspec import structs

from client.sources.frame_source import Source
from client.sources.volume import default_volume, default_voxel
from client.tuning.tune import tune
from protocol.messages import Wishes
from server.client_session import ClientSession
from server.pipeline import FrameResult
from server.quality.operating_point_control import TOLERANCE
from server.quality.pareto_front import ParetoFront, ParetoPoint, write_front
from tests.bench.report.finished import ROOT, Part
from tests.bench.report.run import Run, data_source

BUDGETS_MS = (150.0, 300.0, 600.0)
MODELS = {
    "": {"albedo": "estimated", "indirect": "observed"},
    ", one albedo": {"albedo": "constant", "indirect": "none"},
}
"""What is modelled is asked for and not chosen by a budget: the default, and the thesis's."""
SCENE = "rgbd_livingroom1_synth"
FRAMES = 200
"""Quick or not: what is late are the first ones, in which costs are learnt."""
HOPELESS_FRAMES = 20
"""After which a point that takes far more than the greatest budget is not run to the end."""
IN_TIME, ERROR_GOAL = 0.95, "<= 0.5"
_FRONTS = ROOT / "out" / "bench" / "accuracy" / "fronts"


@dataclass(frozen=True)
class Driven:
    """A run under a budget."""

    totals_ms: list[float]
    settings: list[str]
    errors_deg: list[float]
    """Of the front, by frame."""

    @property
    def changes(self) -> int:
        """Of the point."""
        return sum(a != b for a, b in zip(self.settings, self.settings[1:], strict=False))


def budget_part(run: Run) -> Part:
    """Rows of every budget. Raises UnmeasurableError where the living room is not at hand."""
    source = data_source(SCENE)
    frames = min(FRAMES, len(source))
    part = Part(sizes={"frames under each budget": frames})
    with _fronts_kept_here():
        front = _front(run)
        part.details["front"] = [_plain(point) for point in front.points]
        for words, model in MODELS.items():
            wishes = _wishes(source, model)
            fixed = {p.point.settings: _fixed_ms(run, source, frames, p.point.wishes(wishes)) for p in front.best()}
            part.details[f"fixed_ms{words}"] = fixed
            for budget_ms in BUDGETS_MS:
                run.say(f"a budget of {budget_ms:g} ms{words}")
                driven = _driven(run, source, frames, structs.replace(wishes, preset="auto", budget_ms=budget_ms))
                _add_rows(part, f"living room{words}, budget of {budget_ms:g} ms", budget_ms, driven, front, fixed)
                part.details[f"{budget_ms:g}{words}"] = {"totals_ms": driven.totals_ms, "settings": driven.settings}
    return part


def _add_rows(
    part: Part, row: str, budget_ms: float, driven: Driven, front: ParetoFront, fixed: dict[str, list[float]]
) -> None:
    in_time = _in_time(driven.totals_ms, budget_ms)
    part.add(f"{row}: frames within {TOLERANCE:g} times the budget", in_time, "share", f">= {IN_TIME}")
    part.add(f"{row}: frame, median", median(driven.totals_ms), "ms")
    part.add(f"{row}: changes of the point", driven.changes, "")
    shares = {settings: _in_time(totals_ms, budget_ms) for settings, totals_ms in fixed.items()}
    fitting = [p.light_error_deg for p in front.best() if shares[p.point.settings] >= IN_TIME]
    if not fitting:
        best = max(shares.values())
        reason = f"no point fits: the best keeps {best:.0%} of the frames within {TOLERANCE:g} times the budget"
        part.leave_out(f"{row}: light error above the best that fits", reason)
        return
    half = len(driven.errors_deg) // 2  # the first frames learn what the scene costs
    above = fmean(driven.errors_deg[half:]) - min(fitting)
    part.add(f"{row}: light error above that of the best point that fits", above, "deg", ERROR_GOAL)


def _front(run: Run) -> ParetoFront:
    told = [0]

    def progress(done: int, total: int) -> None:
        if 10 * done // total > told[0]:
            told[0] = 10 * done // total
            run.say(f"the device's front: {done} of {total} frames")

    front = tune(run.device, progress)
    write_front(front)
    return front


@contextmanager
def _fronts_kept_here() -> Iterator[None]:
    """The user's own front stays as it is."""
    before = os.environ.get("PROBELESS_FRONTS")
    os.environ["PROBELESS_FRONTS"] = str(_FRONTS)
    try:
        yield
    finally:
        if before is None:
            del os.environ["PROBELESS_FRONTS"]
        else:
            os.environ["PROBELESS_FRONTS"] = before


def _wishes(source: Source, model: dict[str, str]) -> Wishes:
    """As `probeless run` with nothing else said."""
    volume_m = default_volume(source, range(len(source)))
    return structs.replace(Wishes(volume_m=volume_m, voxel_m=default_voxel(volume_m), up=source.up), **model)


def _in_time(totals_ms: list[float], budget_ms: float) -> float:
    """Share of the frames."""
    return float(np.mean(np.array(totals_ms) <= TOLERANCE * budget_ms))


def _fixed_ms(run: Run, source: Source, frames: int, wishes: Wishes) -> list[float]:
    """Of each frame at one point."""
    totals: list[float] = []
    for result in _results(run, source, frames, wishes):
        totals.append(result.timings.total)
        if len(totals) == HOPELESS_FRAMES and median(totals) > 1.5 * max(BUDGETS_MS):
            break
    return totals


def _driven(run: Run, source: Source, frames: int, wishes: Wishes) -> Driven:
    results = list(_results(run, source, frames, wishes))
    points = [result.plan.point for result in results if result.plan.point is not None]
    return Driven(
        [result.timings.total for result in results],
        [point.settings for point in points],
        [point.light_error_deg or 0.0 for point in points],
    )


def _results(run: Run, source: Source, frames: int, wishes: Wishes) -> Iterator[FrameResult]:
    pipeline = ClientSession(run.device, source.camera, wishes)
    close: Callable[[], None] = pipeline.close
    try:
        for index in range(frames):
            yield pipeline.process(source[index])
    finally:
        close()


def _plain(point: ParetoPoint) -> dict[str, object]:
    return {
        "settings": point.point.settings,
        "ms": point.total_ms,
        "light_error_deg": point.light_error_deg,
        "picture_error": point.picture_error,
    }
