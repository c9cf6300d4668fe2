"""Times: rows sum the events launched under them, and nothing is counted twice."""

from __future__ import annotations

import time
from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest

from server.opencl.engine import Engine, int4
from server.opencl.profile import Profile


@dataclass(frozen=True)
class FakeEvent:
    """An event that took `spent_ns` on the device."""

    spent_ns: int

    @property
    def profile(self) -> Any:
        return type("Times", (), {"start": 5_000_000, "end": 5_000_000 + self.spent_ns})


def add(profile: Profile, kernel: str, spent_ms: float) -> None:
    profile.add_event(kernel, FakeEvent(round(spent_ms * 1e6)))  # type: ignore[arg-type]


def test_rows_sum_their_events() -> None:
    profile = Profile()
    add(profile, "measure", 1.0)
    with profile.stage("surface"):
        add(profile, "raycast", 2.0)
        with profile.stage("rendering"):
            add(profile, "composite", 4.0)
            add(profile, "measure", 8.0)
        add(profile, "raycast", 16.0)
    add(profile, "measure", 32.0)
    rows, kernels = profile.collect()
    assert rows == pytest.approx({"input": 33.0, "surface": 18.0, "rendering": 12.0})
    assert kernels == pytest.approx({"measure": 41.0, "raycast": 18.0, "composite": 4.0})
    assert profile.collect() == ({}, {})


def test_an_error_inside_a_stage_leaves_it() -> None:
    profile = Profile()
    with pytest.raises(ValueError, match="frame"), profile.stage("surface"):
        raise ValueError("frame")
    add(profile, "measure", 1.0)
    assert profile.collect()[0] == pytest.approx({"input": 1.0})


def test_host_time_counts_under_its_row() -> None:
    profile = Profile()
    with profile.stage("light_estimation"):
        add(profile, "accumulate", 3.0)
        for _ in range(2):
            with profile.host():
                time.sleep(0.01)
    rows, kernels = profile.collect()
    assert kernels == pytest.approx({"accumulate": 3.0})
    assert set(rows) == {"light_estimation"}
    assert 23.0 <= rows["light_estimation"] < 1000.0


def test_launched_kernels_are_counted(engine: Engine) -> None:
    solid = engine.workspace.upload("solid", np.zeros((4, 4, 4), np.uint64))
    gaps = [engine.workspace.array(f"gaps_{i}", (2**i * 64,), np.uint8) for i in range(2)]
    with engine.profile.stage("reconstruct"):
        for _ in range(3):
            engine.launch(engine.kernel("volume.cl", "start_gaps"), (64,), 64, solid, 15, gaps[0])
    with engine.profile.stage("surface"):
        kernel = engine.kernel("volume.cl", "gap_along_axis")
        engine.launch(kernel, (4, 4, 8), int4(4, 4, 4, 0), 1, gaps[0], 0, 15, gaps[1])
    engine.queue.finish()
    rows, kernels = engine.profile.collect()
    assert set(rows) == {"reconstruct", "surface"}
    assert rows["reconstruct"] == pytest.approx(kernels["start_gaps"]) != 0
    assert rows["surface"] == pytest.approx(kernels["gap_along_axis"]) != 0
