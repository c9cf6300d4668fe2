"""Times: rows sum the events launched under them, and nothing is counted twice."""

from __future__ import annotations

import time
from dataclasses import dataclass

import numpy as np
import pyopencl as cl
import pytest

from server.opencl.engine import Engine
from server.opencl.profile import Profile

SKEW_S = 1234.5
"""Of the device's clock behind the host's."""


@dataclass(frozen=True)
class FakeEvent:
    """Times on the device's clock, nanoseconds."""

    queued: int
    start: int
    end: int

    def get_profiling_info(self, which: int) -> int:
        times = cl.profiling_info
        return {times.QUEUED: self.queued, times.START: self.start, times.END: self.end}[which]


class Clock:
    """In place of time.perf_counter; seconds, and it stands still but for `wait`."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.now_s = 50.0
        self._free_s = 0.0
        monkeypatch.setattr(time, "perf_counter", lambda: self.now_s)

    def wait(self, ms: float) -> None:
        self.now_s += ms * 1e-3

    def finish(self) -> None:
        self.now_s = max(self.now_s, self._free_s)

    def launch(self, profile: Profile, kernel: str, spent_ms: float) -> None:
        """A kernel that begins when those before have ended."""
        start_s = max(self.now_s, self._free_s)
        self._free_s = start_s + spent_ms * 1e-3
        times = [round((at_s - SKEW_S) * 1e9) for at_s in (self.now_s, start_s, self._free_s)]
        profile.add_event(kernel, FakeEvent(*times))  # type: ignore[arg-type]


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> Clock:
    return Clock(monkeypatch)


def test_rows_sum_their_kernels(clock: Clock) -> None:
    profile = Profile()
    clock.launch(profile, "measure", 1.0)
    with profile.stage("surface"):
        clock.launch(profile, "raycast", 2.0)
        with profile.stage("rendering"):
            clock.launch(profile, "composite", 4.0)
            clock.launch(profile, "measure", 8.0)
        clock.launch(profile, "raycast", 16.0)
    clock.launch(profile, "measure", 32.0)
    clock.finish()
    times = profile.collect()
    assert times.rows == pytest.approx({"input": 33.0, "surface": 18.0, "rendering": 12.0})
    assert times.kernels == pytest.approx({"measure": 41.0, "raycast": 18.0, "composite": 4.0})
    assert times.total == pytest.approx(63.0)
    assert profile.collect().rows == {}


def test_an_error_inside_a_stage_leaves_it(clock: Clock) -> None:
    profile = Profile()
    with pytest.raises(ValueError, match="frame"), profile.stage("surface"):
        raise ValueError("frame")
    profile.begin()
    clock.launch(profile, "measure", 1.0)
    clock.finish()
    assert profile.collect().rows == pytest.approx({"input": 1.0})


def test_host_time_counts_under_its_row_where_no_kernel_runs(clock: Clock) -> None:
    profile = Profile()
    clock.wait(1.0)
    with profile.stage("surface"):
        clock.wait(2.0)
        clock.launch(profile, "raycast", 10.0)
    clock.wait(3.0)  # beside raycast, as what follows
    with profile.stage("light_estimation"):
        clock.wait(5.0)
        clock.finish()  # two more for raycast
        clock.wait(7.0)
        with profile.stage("rendering"):
            clock.wait(0.5)
        clock.launch(profile, "accumulate", 20.0)
        clock.finish()
    clock.wait(0.25)
    times = profile.collect()
    assert times.rows == pytest.approx({"input": 1.0, "surface": 12.0, "light_estimation": 27.25, "rendering": 0.5})
    assert times.total == pytest.approx(sum(times.rows.values()))


def test_of_two_kernels_at_once_the_second_counts_from_the_end_of_the_first(clock: Clock) -> None:
    profile = Profile()
    clock.launch(profile, "raycast", 10.0)
    with profile.stage("light_estimation"):
        start = round((clock.now_s + 0.004 - SKEW_S) * 1e9)
        queued = round((clock.now_s - SKEW_S) * 1e9)
        profile.add_event("arrivals", FakeEvent(queued, start, start + 8_000_000))  # type: ignore[arg-type]
    clock.wait(15.0)
    times = profile.collect()
    assert times.rows == pytest.approx({"input": 10.0, "light_estimation": 5.0})
    assert times.kernels == pytest.approx({"raycast": 10.0, "arrivals": 8.0})
    assert (times.idle, times.total) == pytest.approx((3.0, 15.0))


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
    times = engine.profile.collect()
    assert set(times.rows) == {"input", "reconstruct", "surface"}
    assert set(times.kernels) == {"halve_depth", "clear_depth"}
    assert times.rows["reconstruct"] > 0.99 * times.kernels["halve_depth"] > 0
    assert times.rows["surface"] > 0.99 * times.kernels["clear_depth"] > 0
    assert sum(times.rows.values()) == pytest.approx(times.total)


def test_launches_and_reads_are_counted(engine: Engine) -> None:
    depth = engine.workspace.upload("depth", np.ones((16, 16), np.float32))
    halved = engine.workspace.array("halved", (8, 8), np.float32)
    for _ in range(3):
        engine.launch(engine.kernel("track.cl", "halve_depth", ROWS=16), (8, 8), 8, 8, 16, depth, 0.05, halved)
    engine.download(halved)
    engine.download(depth)
    engine.begin_download(depth)  # nobody waits for it
    engine.copy_into(depth, 0, halved)
    profile = engine.profile
    assert (profile.launches, profile.reads, profile.read_bytes) == (3, 2, 4 * (64 + 256))
    assert profile.copies == 5, "an upload, three reads, one on the device"
    profile.collect()
    assert (profile.launches, profile.reads, profile.read_bytes, profile.copies) == (0, 0, 0, 0)


def test_a_host_that_is_held_up_moves_no_kernel_out_of_the_frame(clock: Clock) -> None:
    """The host reads its clock 7 ms after the launch: as on a machine that does something else."""
    profile = Profile()
    with profile.stage("surface"):
        start_s = clock.now_s
        times = [round((at_s - SKEW_S) * 1e9) for at_s in (start_s, start_s, start_s + 2e-3)]
        clock.wait(7.0)
        profile.add_event("raycast", FakeEvent(*times))  # type: ignore[arg-type]
    found = profile.collect()
    assert found.kernels == pytest.approx({"raycast": 2.0})
    assert found.rows == pytest.approx({"surface": 7.0})
