"""Long launches in slices: each work-item once, few ahead of the device, others let by in between."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from itertools import product
from pathlib import Path

import numpy as np
import pyopencl as cl
import pytest

from server.opencl import program
from server.opencl.device import Device
from server.opencl.engine import Engine
from server.opencl.pacing import PROBE, SHARED_SLICE_S, SLICE_S, Pacer, StepTimes, cut
from server.opencl.profile import Profile

SOURCE = """
#include "groups.clh"

kernel void count_visits(const int width, const int height, const int depth, global int *visits) {
    const int x = get_global_id(0), y = get_global_id(1), z = get_global_id(2);
    if (x >= width || y >= height || z >= depth) return;
    visits[(z * height + y) * width + x] += 1;
}

kernel void number_groups(global int *groups) { groups[get_global_id(0)] = group_number(); }
"""
INCLUDE = program.KERNEL_FOLDER / "include"


@pytest.fixture(autouse=True)
def kernels(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """These kernels in place of the real ones."""
    (tmp_path / "pacing_test.cl").write_text(SOURCE)
    (tmp_path / "include").symlink_to(INCLUDE)
    monkeypatch.setattr(program, "KERNEL_FOLDER", tmp_path)


class Other:
    """Somebody who wants the device after each of the first launches and slices."""

    def __init__(self, engine: Engine, times: int) -> None:
        self.engine, self.times, self.given, self.releases = engine, times, 0, 0
        self.unfinished = 0
        """Kernels that were on the device while it was given away."""

    def is_due(self) -> bool:
        return self.given < self.times

    def give_way(self) -> None:
        self.given += 1
        self._note()

    @contextmanager
    def released(self) -> Iterator[None]:
        self.releases += 1
        self._note()
        yield

    def _note(self) -> None:
        self.unfinished += sum(one.event.command_execution_status != 0 for one in self.engine.profile._slices)


@pytest.mark.parametrize(
    ("size", "local", "most"),
    [
        ((640,), (64,), 1000),
        ((64,), (64,), 1),
        ((1920, 1200), (16, 4), 100_000),
        ((1920, 1200), (16, 4), 500),
        ((1920, 1200), (16, 4), 10),
        ((24, 16, 5), (8, 8, 1), 200),
        ((24, 16, 5), (8, 8, 1), 24 * 16 * 2),
        ((24, 16, 5), (8, 8, 1), 10**9),
    ],
)
def test_parts_cover_a_launch_once(size: tuple[int, ...], local: tuple[int, ...], most: int) -> None:
    covered = Counter[tuple[int, ...]]()
    for offset, part in cut(size, local, lambda: most):
        assert all(extent % group == 0 for extent, group in zip(part, local, strict=True))
        assert np.prod(part) <= max(most, np.prod(local))
        covered.update(product(*(range(o, o + e, g) for o, e, g in zip(offset, part, local, strict=True))))
    assert covered == Counter(product(*(range(0, extent, group) for extent, group in zip(size, local, strict=True))))


def test_a_launch_that_is_short_enough_is_whole() -> None:
    assert list(cut((1920, 1200), (16, 4), lambda: 1920 * 1200)) == [((0, 0), (1920, 1200))]


@pytest.mark.parametrize("size", [(65,), (1000,), (17, 5), (97, 71), (9, 8, 3)])
def test_every_item_runs_once_in_slices(engine: Engine, size: tuple[int, ...]) -> None:
    engine.pacer = Pacer(slice_s=1e-6)  # at first one work-group each
    full = (*size, 1, 1)[:3]
    visits = engine.workspace.upload("visits", np.zeros(full[::-1], np.int32))
    engine.launch(engine.kernel("pacing_test.cl", "count_visits"), size, *full, visits)
    assert (engine.download(visits) == 1).all()
    assert engine.profile.slices > 1


def test_groups_are_numbered_through_all_slices(engine: Engine) -> None:
    engine.pacer = Pacer(slice_s=1e-6)
    groups = engine.workspace.upload("groups", np.zeros(640, np.int32))
    engine.launch(engine.kernel("pacing_test.cl", "number_groups"), (640,), groups)
    assert (engine.download(groups) == np.arange(640) // 64).all()
    assert engine.profile.slices == 10


@pytest.mark.parametrize(("steps", "slices"), [(1, 1), (1000, 10)])
def test_work_items_of_many_steps_make_smaller_slices(engine: Engine, steps: int, slices: int) -> None:
    engine.pacer = Pacer(slice_s=0.1, step_s=0.1 / 64_000)
    groups = engine.workspace.upload("groups", np.zeros(640, np.int32))
    engine.launch(engine.kernel("pacing_test.cl", "number_groups"), (640,), groups, steps=steps)
    assert engine.profile.slices == slices


def test_a_kernel_that_was_slow_is_cut_the_next_time(engine: Engine) -> None:
    engine.pacer = Pacer(slice_s=1e-7, step_s=1e-15)  # nothing takes as little as this says
    groups = engine.workspace.upload("groups", np.zeros(6400, np.int32))
    kernel = engine.kernel("pacing_test.cl", "number_groups")
    engine.launch(kernel, (6400,), groups)
    engine.queue.finish()
    assert engine.profile.slices == 1
    engine.launch(kernel, (64,), groups)  # which learns of the first
    engine.launch(kernel, (6400,), groups)
    assert engine.profile.slices > 3


def test_others_are_let_by_between_slices_while_the_device_is_idle(engine: Engine) -> None:
    engine.pacer = Pacer(slice_s=1e-6)
    engine.pacer.yielding = other = Other(engine, 3)
    groups = engine.workspace.upload("groups", np.zeros(640, np.int32))
    engine.launch(engine.kernel("pacing_test.cl", "number_groups"), (640,), groups)
    assert other.given == 3
    assert other.unfinished == 0
    assert (engine.download(groups) == np.arange(640) // 64).all()


class _Event:
    """A kernel that ends only when it is waited for."""

    command_execution_status = 1

    def __init__(self, log: list[int], number: int, took_ns: int = 1_000_000) -> None:
        self.log, self.number = log, number
        self.took_ns = took_ns

    def get_profiling_info(self, which: int) -> int:
        return {cl.profiling_info.START: 0, cl.profiling_info.END: self.took_ns}[which]

    def wait(self) -> None:
        self.log.append(self.number)


def test_no_more_is_enqueued_ahead_than_a_device_needs() -> None:
    pacer, waited = Pacer(slice_s=1.0, ahead_s=0.0035, step_s=0.001), list[int]()
    for number in range(10):  # of a millisecond each
        for _ in pacer.slices("kernel", (1,), (1,), 1):
            pacer.enqueued("kernel", 1, 1, _Event(waited, number))
        assert number + 1 - len(waited) <= 4
    assert waited == list(range(6))


def test_slices_of_a_launch_become_smaller_while_the_device_becomes_slower() -> None:
    pacer, sizes = Pacer(slice_s=0.1, ahead_s=0.0, step_s=0.001), list[int]()
    for number, (_, (items,)) in enumerate(pacer.slices("kernel", (1000,), (1,), 1)):
        sizes.append(items)
        step_ns = 1_000_000 if number < 3 else 10_000_000
        pacer.enqueued("kernel", items, 1, _Event([], number, items * step_ns))
    assert sizes[:4] == [100, 100, 100, 100]
    assert max(sizes[5:]) < 15, "a tenth of the items in the same time, and slowly more as that is forgotten"


def test_a_kernel_that_was_never_timed_begins_with_a_short_slice_that_is_waited_for(engine: Engine) -> None:
    """With 50 times the time a step is thought to take: no slice takes more than three times the longest."""
    took_s, step_s, pacer = list[float](), 1e-6, Pacer(slice_s=0.02, ahead_s=0.02, step_s=2e-8)
    pacer.yielding = Other(engine, 0)
    for number, (_, (items,)) in enumerate(pacer.slices("kernel", (1_000_000,), (1,), 1)):
        took_s.append(items * step_s)
        pacer.enqueued("kernel", items, 1, _Event([], number, int(1e9 * items * step_s)))
    assert max(took_s) <= PROBE * 0.02 * 50 * 1.01
    assert max(took_s[1:]) <= 0.0201


def test_launches_of_an_engine_are_cut_by_what_those_of_others_on_its_device_took(device: Device) -> None:
    one, other = Engine(device), Engine(device)
    assert one.pacer._times is other.pacer._times is device.step_times
    times, sizes = StepTimes(), list[int]()
    for pacer in (Pacer(slice_s=0.1, step_s=1e-9, times=times), Pacer(slice_s=0.1, step_s=1e-9, times=times)):
        for number, (_, (items,)) in enumerate(pacer.slices("kernel", (1000,), (1,), 1)):
            sizes.append(items)
            pacer.enqueued("kernel", items, 1, _Event([], number, items * 1_000_000))
        pacer._drain(0.0)
    assert sizes == [1000, *[100] * 10]


def test_slices_are_shorter_where_others_may_want_the_device(engine: Engine) -> None:
    pacer, sizes = Pacer(step_s=1e-3), list[int]()
    for yielding in (None, Other(engine, 0)):
        pacer.yielding = yielding
        pacer._times.add("kernel", 1e-3)
        sizes.append(next(iter(pacer.slices("kernel", (1000,), (1,), 1)))[1][0])
    assert sizes == [int(SLICE_S / 1e-3), int(SHARED_SLICE_S / 1e-3)]


def test_a_short_slice_tells_nothing_of_its_kernels_steps() -> None:
    pacer = Pacer(slice_s=0.1, step_s=1e-8)
    pacer.enqueued("kernel", 64, 1, _Event([], 0, 30_000))  # 470 ns a step: its launch
    pacer._drain(0.0)
    assert next(iter(pacer.slices("kernel", (100_000,), (1,), 1)))[1] == (100_000,)


def test_a_kernel_that_was_held_up_once_is_whole_again_soon() -> None:
    """Whatever else the machine did meanwhile: a slice of 64 items that took a second, of a kernel of 100 ns a step."""
    pacer, slices = Pacer(slice_s=0.05), list[int]()
    pacer.enqueued("kernel", 64, 1, _Event([], 0, 1_000_000_000))
    pacer._drain(0.0)
    for _ in range(30):
        slices.append(0)
        for _, (items,) in pacer.slices("kernel", (6400,), (64,), 1):
            slices[-1] += 1
            pacer.enqueued("kernel", items, 1, _Event([], 0, 20_000 + 100 * items))
        pacer._drain(0.0)
    assert slices[0] > 10
    assert slices[-1] == 1


def test_the_profile_counts_slices_of_one_kernel_together(engine: Engine) -> None:
    engine.pacer, engine.profile = Pacer(slice_s=1e-6), Profile()
    groups = engine.workspace.upload("groups", np.zeros(640, np.int32))
    engine.launch(engine.kernel("pacing_test.cl", "number_groups"), (640,), groups)
    engine.queue.finish()
    assert set(engine.profile.collect().kernels) == {"number_groups"}


def test_others_have_the_device_while_kernels_are_compiled(engine: Engine) -> None:
    engine.pacer.yielding = other = Other(engine, 0)
    groups = engine.workspace.upload("groups", np.zeros(640, np.int32))
    for _ in range(3):
        engine.launch(engine.kernel("pacing_test.cl", "number_groups", OF_THIS_TEST=1), (640,), groups)
    assert (other.given, other.releases) == (0, 2), "once for the program, once for the first launch"
    assert other.unfinished == 0
