"""Times: rows sum the events launched under them, and nothing is counted twice."""

from __future__ import annotations

import time
from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest

from server.opencl.engine import Engine
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
    depth = engine.workspace.upload("depth", np.ones((16, 16), np.float32))
    halved = engine.workspace.array("halved", (8, 8), np.float32)
    depths = [engine.workspace.array(name, (256,), np.uint32) for name in ("surface", "points")]
    with engine.profile.stage("reconstruct"):
        for _ in range(3):
            engine.launch(engine.kernel("track.cl", "halve_depth", ROWS=16), (8, 8), 8, 8, 16, depth, 0.05, halved)
    with engine.profile.stage("surface"):
        engine.launch(engine.kernel("register.cl", "clear_depth"), (256,), 256, *depths)
    engine.queue.finish()
    rows, kernels = engine.profile.collect()
    assert set(rows) == {"reconstruct", "surface"}
    assert rows["reconstruct"] == pytest.approx(kernels["halve_depth"]) != 0
    assert rows["surface"] == pytest.approx(kernels["clear_depth"]) != 0


def test_launches_and_reads_are_counted(engine: Engine) -> None:
    depth = engine.workspace.upload("depth", np.ones((16, 16), np.float32))
    halved = engine.workspace.array("halved", (8, 8), np.float32)
    for _ in range(3):
        engine.launch(engine.kernel("track.cl", "halve_depth", ROWS=16), (8, 8), 8, 8, 16, depth, 0.05, halved)
    engine.download(halved)
    engine.download(depth)
    profile = engine.profile
    assert (profile.launches, profile.reads, profile.read_bytes) == (3, 2, 4 * (64 + 256))
    profile.collect()
    assert (profile.launches, profile.reads, profile.read_bytes) == (0, 0, 0)
