"""The benchmark of what a room's light costs, in short, by clocks of known steps."""

from __future__ import annotations

from types import SimpleNamespace

import pytest

from server.light.shell.room_model import SOLVE_EVERY
from server.opencl.device import Device
from tests.bench.light import room_cost
from tests.bench.light import speed as light_speed
from tests.bench.report.run import Run
from tests.data import data_folder

STEP_S = 0.3
"""By which a clock goes on whenever it is read, so that all that is timed takes as long."""


class Clock:
    def __init__(self) -> None:
        self.read = 0

    def __call__(self) -> float:
        self.read += 1
        return STEP_S * self.read


def test_times_are_of_a_solution_by_its_frames_and_of_a_place(device: Device, monkeypatch: pytest.MonkeyPatch) -> None:
    data_folder("rgbd_7scenes_redkitchen")
    solved = Clock()
    monkeypatch.setattr(room_cost, "time", SimpleNamespace(thread_time=solved))
    monkeypatch.setattr(light_speed, "time", SimpleNamespace(perf_counter=Clock(), process_time=Clock()))
    rows = {row.name: row.value for row in room_cost.room_cost_part(Run(device, True, print)).rows}
    assert solved.read >= 4  # two of a solution, in each half of the frames
    whole_ms = 1e3 * STEP_S
    assert list(rows.values()) == pytest.approx([whole_ms, whole_ms / SOLVE_EVERY, whole_ms, whole_ms / 8])
    assert ["a frame" in name for name in rows] == [False, True, False, False]
