"""Rows of composites against their truth, and what the issue holds them to."""

from __future__ import annotations

from tests.bench.rendering.flip import Codes
from tests.bench.report.finished import Part
from tests.bench.truth.composite_truth import CompositeTruth, score

ERROR_GOALS = {"rm": 0.06, "art4": 0.08, "gr15": 0.10, "gr15fast": 0.10}
"""FLIP of presets under the true light, which has one bounce."""
SHADOW_GOALS = {"rm": 0.9, "gr15fast": 0.8}
PASTED_GOAL = 0.5


def add_score(
    part: Part,
    row: str,
    truth: CompositeTruth,
    composites: list[Codes],
    of_pasted: float,
    error_goal: float | None,
    shadow_goal: float | None,
    is_held: bool = True,
) -> None:
    """Rows of one run. `of_pasted`: the baseline's FLIP, which a run that is held stays below half of."""
    found = score(truth, composites)
    part.add(f"{row}: FLIP of what the objects change", found.error, "", f"<= {error_goal}" if error_goal else "")
    pasted_goal = f"<= {PASTED_GOAL}" if is_held else ""
    part.add(f"{row}: FLIP over that of pasting", found.error / of_pasted, "", pasted_goal)
    part.add(f"{row}: FLIP of what the objects change, last frame", found.last_error, "")
    part.add(f"{row}: FLIP of the objects alone", found.object_error, "")
    part.add(f"{row}: FLIP of real surface alone", found.real_error, "")
    part.add(f"{row}: objects' mean luminance over the true", found.brightness, "")
    held = f">= {shadow_goal}" if shadow_goal else ""
    part.add(f"{row}: shadow, correlation", found.shadow_correlation, "", held)
    part.add(f"{row}: shadow, slope of predicted on true", found.shadow_slope, "")


def add_pasted(part: Part, row: str, truth: CompositeTruth) -> float:
    """The baseline's row; returns its FLIP."""
    error = score(truth, truth.pasted).error
    part.add(f"{row}: pasted without shadows: FLIP of what the objects change", error, "")
    return error
