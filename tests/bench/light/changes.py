"""A light that changes while a camera walks through a room: the light at a place, beside that of rooms where it was
always on, and of rooms that are new when it comes on."""

from __future__ import annotations

from collections.abc import Sequence

import msgspec
import numpy as np
from numpy.typing import NDArray

from client.synthetic.source import SyntheticSource, open_synthetic
from protocol.messages import Wishes
from tests.bench.light.runs import results_of, wishes_for
from tests.bench.report.finished import Part
from tests.bench.report.run import Run

CHANGES, QUICK_CHANGES = ((0, 1), (1, 2), (2, 3), (3, 0), (2, 1), (0, 3)), 2
"""Numbers of the lights before and after."""
BEFORE, AFTER = (10, 25), 10
"""Frames; each change comes early and late."""
FOLLOWED = 3
"""The goal is that a light is followed within so many frames."""
PLACE = (0.0, 0.0, 1.0)

Floats = NDArray[np.float64]


def changes_part(run: Run) -> Part:
    """Levels are over those of a room where the light was always on: what a camera has seen of it by then."""
    changes = CHANGES[: run.of(QUICK_CHANGES, len(CHANGES))]
    part = Part(sizes={"changes of light": len(BEFORE) * len(changes)})
    off: dict[str, list[Floats]] = {"": [], "new room, ": []}
    for first, then in changes:
        for before in BEFORE:
            run.say(f"light {first}, then {then} after {before} frames")
            walk, changed = range(before + AFTER), slice(before, None)
            always = _levels(run, [(then, index) for index in walk])[changed]
            found = _levels(run, [(first if index < before else then, index) for index in walk])[changed]
            new = _levels(run, [(then, index) for index in walk[changed]])
            off[""].append(np.abs(np.log(found / always)))
            off["new room, "].append(np.abs(np.log(new / always)))
    for words, of_changes in off.items():
        for frame in (1, FOLLOWED, AFTER):
            factors = np.exp(np.array(of_changes)[:, frame - 1])
            row = f"light that changes: {words}level in frame {frame}, off by a factor of"
            part.add(f"{row}, median", float(np.median(factors)), "")
            part.add(f"{row}, worst", float(factors.max()), "")
    typical, of_new = (float(np.median(np.array(of_changes)[:, FOLLOWED - 1])) for of_changes in off.values())
    row = f"light that changes: frame {FOLLOWED}, median, logarithm over that of a new room"
    part.add(row, typical / of_new, "times", "<= 1.1")
    return part


def _levels(run: Run, frames: Sequence[tuple[int, int]]) -> Floats:
    """[n] norm of the light at PLACE after each of `frames`: number of the light, and of the frame."""
    sources = {light: _room(light) for light, _ in frames}
    source = next(iter(sources.values()))
    wishes = msgspec.structs.replace(
        wishes_for(source, range(len(source))),
        preset=Wishes().preset,
        albedo="estimated",
        indirect="observed",
        light_at=(PLACE,),
    )
    shown = (sources[light][index] for light, index in frames)
    found = results_of(run.device, source, shown, wishes)
    return np.array([np.linalg.norm(lit.sh) for result in found for lit in result.light.at if lit.of == "place"])


def _room(light: int) -> SyntheticSource:
    return open_synthetic(f"synthetic:room?frames=60&size=160x120&light={light}")
