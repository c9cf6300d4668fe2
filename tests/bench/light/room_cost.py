"""What the light of a room costs: its solutions, which are worked out beside the frames, and the light at a place."""

from __future__ import annotations

import time
from dataclasses import dataclass, field
from functools import partial
from statistics import median
from unittest.mock import patch

import numpy as np
from numpy.typing import NDArray

from client.sources.frame_source import Source
from client.sources.volume import default_volume, default_voxel
from protocol.messages import Wishes
from server.client_session import ClientSession
from server.geometry.geometry import Geometry
from server.light.shell import solver_process
from server.light.shell.bright_surface import EmittersSeen
from server.light.shell.patches import Patches
from server.light.shell.room_model import SOLVE_EVERY
from server.light.shell.solution import Solution
from server.light.shell.solver import Solver
from server.light.shell.switches import Switches
from server.opencl.engine import Engine
from tests.bench.light.places import KITCHEN
from tests.bench.light.speed import timed
from tests.bench.report.finished import Part
from tests.bench.report.run import Run, data_source

FRAMES, QUICK_FRAMES = 90, 12
FIRST = 30
"""Frames of the first second, in which all is new and nearly every frame is solved: they are not counted."""
UPDATE_GOAL, PLACE_GOAL = "<= 40", "<= 2"
PLACES = {"one place": 1, "each of eight places": 8}
"""Asked for at once."""

Floats = NDArray[np.float64]


@dataclass
class _Solved:
    solution: Solution | None = None
    """The newest."""
    spent_ms: list[float] = field(default_factory=list)
    """Processor time of each."""


class _TimedSolver(Solver):
    """Notes what solutions cost."""

    def __init__(self, solved: _Solved, switches: Switches) -> None:
        super().__init__(switches)
        self._solved = solved

    def solve(
        self, patches: Patches, bright: EmittersSeen, traced: NDArray[np.int64], camera: Floats, up: Floats
    ) -> Solution | None:
        begin = time.thread_time()
        self._solved.solution = super().solve(patches, bright, traced, camera, up)
        self._solved.spent_ms.append((time.thread_time() - begin) * 1e3)
        return self._solved.solution


def room_cost_part(run: Run) -> Part:
    """Processor time of a solution of the real kitchen's light, in one thread, and of the light at one place."""
    source, count = data_source(KITCHEN), run.of(QUICK_FRAMES, FRAMES)
    first, volume_m = min(FIRST, count // 2), default_volume(source, range(count))
    wishes = Wishes(volume_m=volume_m, voxel_m=default_voxel(volume_m), up=source.up)
    part = Part(sizes={"frames whose light is timed": count - first})
    solved = _solved(run, source, wishes, range(count), first)
    row = "kitchen, a solution of the light, in one thread: processor time"
    part.add(f"{row}, median", median(solved.spent_ms), "ms")
    part.add(f"{row} a frame, median", median(solved.spent_ms) / SOLVE_EVERY, "ms", UPDATE_GOAL)
    assert solved.solution is not None
    _add_place(part, run, source, wishes, range(count), solved.solution)
    return part


def _solved(run: Run, source: Source, wishes: Wishes, frames: range, first: int) -> _Solved:
    """After `frames`, with the times of those from `first` on."""
    solved = _Solved()
    with patch.multiple(solver_process, IS_SUPPORTED=False, Solver=partial(_TimedSolver, solved)):
        session = ClientSession(run.device, source.camera, wishes)
        for index in frames:
            run.say(f"what the kitchen's light costs: frame {index + 1} of {len(frames)}")
            if index == first:
                solved.spent_ms.clear()
            session.process(source[index])
        session.close()
    return solved


def _add_place(part: Part, run: Run, source: Source, wishes: Wishes, frames: range, solution: Solution) -> None:
    """About a metre in front of the last camera, in a scan of the same frames."""
    engine = Engine(run.device)
    geometry = Geometry(engine, source.camera, wishes)
    for index in frames:
        geometry.scan(source[index])
    volume, pose = geometry.volume, np.array(source[frames[-1]].world_from_camera)
    assert volume is not None
    middle, trials = pose[:3, 3] + pose[:3, 2], run.of(10, 50)
    for words, places in PLACES.items():
        at = middle + np.linspace(-0.2, 0.2, places)[:, None] * pose[:3, 0]
        _, cpu_ms = timed(engine, lambda at=at: solution.arriving(solution.look_up(engine, volume, at)), trials)
        row = f"kitchen, the light at {words}: processor time, median"
        part.add(row, median(cpu_ms) / places, "ms", PLACE_GOAL)
    engine.close()
