"""Tables 6.2 and 6.3: what a whole update takes by the thesis's rows, one virtual thing in view, and who is fastest."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from typing import Any

from protocol.messages import Wishes
from server.scene.placement import Placement
from tests.bench.light.runs import at_preset
from tests.bench.report.finished import Part
from tests.bench.report.run import Run
from tests.bench.thesis.numbers import FAMILIES, THESIS_NAME
from tests.bench.thesis.runs import (
    WARM_UP,
    Times,
    cores_of,
    medians,
    no_times,
    note_times,
    scene,
    turn_by_turn,
    vase,
)

SIZE = "640x480"
RAYS = 81
CUBE_M = (-1.0, -0.6, -1.0, 1.0, 1.4, 1.0)
"""2 m to each side, the table in it."""
SIDE_M = 2.0
REACH_M = 0.1
"""Of the thesis's rays (6.1.3)."""
VASE = Placement(position_m=(0.08, 0.0, 0.12), scale=0.9)
GOAL_FPS, GPU_GOAL_FPS = 10, 300
"""Of GR15FAST: at 64^3 without D''' on two cores (the thesis's tablet: 5.0), at 256^3 on a GPU (its GTX 780: 22.5)."""
GOAL_CORES = 2
FASTER = ("rm", "art4", "gr15", "gr15fast")
"""The thesis's order, slowest first."""

AS_THESIS, USUAL = "as thesis", "usual"
MODES: dict[str, dict[str, Any]] = {
    AS_THESIS: {"albedo": "constant", "indirect": "none", "ray_length_m": REACH_M},
    USUAL: {"albedo": "estimated", "indirect": "observed"},
}
"""Rays of 0.1 m, one albedo and no indirect light; and what the command line does by itself, rays through the room."""


@dataclass(frozen=True)
class Table:
    """One of the two."""

    number: str
    voxels: int
    """Along an edge of the cube."""
    presets: tuple[str, ...]
    smooth_depth: bool


TABLES = (
    Table("6.2", 256, FAMILIES, smooth_depth=True),
    Table("6.3", 64, ("gr15", "gr15fast"), smooth_depth=False),
)


def speed_part(run: Run, size: str = SIZE, frames: int | None = None) -> Part:
    """Rows of both tables; `details` by table, mode and preset."""
    frames = frames or run.of(6, 33)
    part = Part(sizes={"frames of tables 6.2 and 6.3": frames - WARM_UP})
    part.details = {"is_gpu": run.device.is_gpu, "cores": cores_of(run.device), "device": run.device.name}
    source = scene(f"synthetic:table?size={size}&frames={frames}&noise=1&texture=1")
    pictures = [source[i] for i in range(frames)]
    for table in TABLES:
        part.details[table.number] = {}
        for mode, others in MODES.items():
            run.say(f"table {table.number}, {mode}: {', '.join(table.presets)}")
            wishes = Wishes(
                volume_m=CUBE_M,
                voxel_m=SIDE_M / table.voxels,
                up=source.up,
                rays=RAYS,
                smooth_depth=table.smooth_depth,
                **others,
            )
            times = {preset: no_times() for preset in table.presets}
            lanes = {preset: at_preset(wishes, preset) for preset in table.presets}
            for _frame, answers in turn_by_turn(run.device, source.camera, pictures, lanes, [(vase(), VASE)]):
                for preset, answer in answers.items():
                    note_times(times[preset], answer)
            part.details[table.number][mode] = {preset: medians(taken) for preset, taken in times.items()}
            _add_rows(part, run, table, mode, times)
    _add_gpu(part, run)
    return part


def _add_rows(part: Part, run: Run, table: Table, mode: str, times: dict[str, Times]) -> None:
    found = {preset: medians(taken) for preset, taken in times.items()}
    for preset, row in found.items():
        words = f"table {table.number}, {mode}: {THESIS_NAME[preset]} at {table.voxels}^3"
        goal = _goal(run, table, mode, preset)
        part.add(f"{words}: median", row["fps"], "frames/s", goal)
        if not run.device.is_gpu:
            cores = cores_of(run.device)
            part.add(f"{words}: by processor time over {cores} cores", 1e3 / row["cpu"], "frames/s", goal)
    ms = "total" if run.device.is_gpu else "cpu"
    for slower, faster in pairwise([preset for preset in FASTER if preset in found]):
        ratio = found[slower][ms] / found[faster][ms]
        words = f"order of speed, table {table.number}, {mode}: {THESIS_NAME[faster]} over {THESIS_NAME[slower]}"
        part.add(f"{words}, frames/s", ratio, "", ">= 1")


def _goal(run: Run, table: Table, mode: str, preset: str) -> str:
    if preset != "gr15fast" or mode != AS_THESIS:
        return ""
    if run.device.is_gpu:
        return f">= {GPU_GOAL_FPS}" if table.voxels == 256 else ""
    return f">= {GOAL_FPS}" if table.number == "6.3" and cores_of(run.device) == GOAL_CORES else ""


def _add_gpu(part: Part, run: Run) -> None:
    if not run.device.is_gpu:
        part.leave_out(f"table 6.2: GR15FAST at 256^3 on a GPU, >= {GPU_GOAL_FPS} frames/s", "no GPU at hand")
