"""Figures 5.5, 5.6 and 5.7: naive against robust estimation on the stage set, and the length of visibility rays."""

from __future__ import annotations

from typing import Any

import msgspec
import numpy as np

from client.synthetic.source import SyntheticSource
from protocol.messages import Wishes
from server.maths.light_direction import direction_error_deg
from server.pipeline import FrameResult
from server.shading.composite import srgb_codes
from tests.bench.light.environment import environment_difference
from tests.bench.light.runs import light_in
from tests.bench.report.finished import Part
from tests.bench.report.run import Run
from tests.bench.thesis.numbers import RAY_LENGTHS_M
from tests.bench.thesis.runs import guests_of, save_picture, scene, turn_by_turn, usual_wishes

SIZE, QUICK_SIZE = "640x480", "320x240"
SETS = {"B": "paper", "C": "market"}
"""Of the stage set: one geometry, grey as paper and with many colours, as the thesis's scenes B and C."""
LIGHTS = (7, 1, 3, 5)
"""On the ring around the scene, 90 degrees apart."""
GUEST = "ball"
NAIVE, MEASURES, OURS = "naive", "thesis's measures", "ours"
WAYS: dict[str, dict[str, Any]] = {
    NAIVE: {"as_thesis": True, "robustness": ()},
    MEASURES: {"as_thesis": True, "robustness": ("openness", "normals", "memory")},
    OURS: {},
}
"""Plain least squares of white light with one albedo; that with 5.2 and 5.4; albedos, colours and a prior."""
SPREAD = 96
"""Frames of the walk, in 360 for a whole round, from which a set's frames are taken."""

RAY_SCENE = "synthetic:stage?texture=paper"
RAY_LIGHT = 7
WHOLE = "room"


def robust_part(run: Run, size: str | None = None, frames: int | None = None) -> Part:
    """Figures 5.5 and 5.6: each set under each light, in each of WAYS."""
    size, frames = size or (QUICK_SIZE if run.quick else SIZE), frames or run.of(4, 24)
    part = Part(sizes={"frames of fig. 5.5": frames})
    for name, look in SETS.items():
        cells = []
        wishes = usual_wishes(scene(f"synthetic:stage?size=80x60&frames={SPREAD}"))
        for light in LIGHTS:
            run.say(f"fig. 5.5, scene {name}: light {light}")
            spec = f"synthetic:stage?size={size}&frames={SPREAD}&texture={look}&light={light}"
            bare, full = scene(spec), scene(f"{spec}&with={GUEST}")
            lanes = {way: msgspec.structs.replace(wishes, **others) for way, others in WAYS.items()}
            results = last_results(run, bare, lanes, frames, full)
            true = bare.truth(_indices(frames)[-1]).sh
            cell = {way: _cell(f"5.5 {name} {light} {way}", result, true) for way, result in results.items()}
            cell["true"] = _true_cell(f"5.5 {name} {light} true", full, _indices(frames)[-1])
            cells.append(cell)
        part.details[name] = {"lights": list(LIGHTS), "cells": cells}
        for way in WAYS:
            errors = [cell[way]["direction_deg"] for cell in cells]
            row = f"fig. 5.5, scene {name} ({look}), {way}"
            goal = f"<= {part_mean(part, name, NAIVE):.6g}" if way == OURS else ""
            part.add(f"{row}: mean angle to the true light", float(np.mean(errors)), "deg", goal)
            differences = [cell[way]["msad"] for cell in cells]
            part.add(f"{row}: environment map, mean relative MSAD", float(np.mean(differences)), "")
    return part


def part_mean(part: Part, name: str, way: str) -> float:
    """Mean angle of a way over the lights of a set."""
    return float(np.mean([cell[way]["direction_deg"] for cell in part.details[name]["cells"]]))


def reach_part(run: Run, size: str | None = None, frames: int | None = None) -> Part:
    """Figure 5.7: one scene, rays of each length and through the whole room; one albedo, so that only rays differ."""
    size, frames = size or (QUICK_SIZE if run.quick else SIZE), frames or run.of(5, 24)
    part = Part(sizes={"frames of fig. 5.7": frames})
    errors: dict[str, list[float]] = {}
    wishes = usual_wishes(scene(f"{RAY_SCENE}&size=80x60&frames={SPREAD}"), albedo="constant")
    for light in LIGHTS:
        run.say(f"fig. 5.7: light {light}")
        spec = f"{RAY_SCENE}&size={size}&frames={SPREAD}&light={light}"
        bare, full = scene(spec), scene(f"{spec}&with={GUEST}")
        lanes = {f"{reach:g} m": msgspec.structs.replace(wishes, ray_length_m=reach) for reach in RAY_LENGTHS_M}
        lanes[WHOLE] = wishes
        results = last_results(run, bare, lanes, frames, full)
        true = bare.truth(_indices(frames)[-1]).sh
        for name, result in results.items():
            cell = _cell(f"5.7 {light} {name}", result, true)
            errors.setdefault(name, []).append(cell["direction_deg"])
            if light == RAY_LIGHT:
                part.details.setdefault("cells", {})[name] = cell
        if light == RAY_LIGHT:
            part.details["true"] = _true_cell(f"5.7 {light} true", full, _indices(frames)[-1])
    part.details["errors"] = errors
    for name, angles in errors.items():
        goal = f"<= {np.mean(errors['0 m']):.6g}" if name == WHOLE else ""
        part.add(f"fig. 5.7, rays {name}: mean angle to the true light", float(np.mean(angles)), "deg", goal)
    return part


def _indices(frames: int) -> list[int]:
    """Spread over the walk; the last shows the guests from where it began."""
    return [round(i) for i in np.linspace(SPREAD - 1, 0, frames)]


def last_results(
    run: Run, bare: SyntheticSource, lanes: dict[str, Wishes], frames: int, full: SyntheticSource
) -> dict[str, FrameResult]:
    """What each of `lanes` made of the last of `frames` frames, with the guests of `full` as virtual things."""
    pictures = (bare[i] for i in _indices(frames))
    answers = {}
    for _frame, answers in turn_by_turn(run.device, bare.camera, pictures, lanes, guests_of(full)):  # noqa: B007
        pass
    return {name: answer.result for name, answer in answers.items()}


def _cell(name: str, result: FrameResult, true: np.ndarray) -> dict[str, Any]:
    light = light_in(result)
    return {
        "picture": save_picture(name, result.color),
        "light": light.tolist(),
        "direction_deg": direction_error_deg(light, true),
        "msad": environment_difference(light, true),
    }


def _true_cell(name: str, full: SyntheticSource, index: int) -> dict[str, Any]:
    truth = full.truth(index)
    return {"picture": save_picture(name, srgb_codes(truth.radiance)), "light": truth.sh.tolist()}
