"""The process that solves a room's light: it finds what the solver finds, and its end is not the light's."""

from __future__ import annotations

import gc
import logging
import os
import pickle
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pytest

from client.options.source import open_source
from client.sources.volume import default_volume, default_voxel
from protocol.messages import Wishes
from server.children.nursery import ChildDied, Nursery
from server.children.process_pool import IS_SUPPORTED
from server.client_session import ClientSession
from server.light.shell import solver_process
from server.light.shell.solution import Solution
from server.light.shell.solver import Solver
from server.light.shell.solver_process import JOB, SolverProcess, Task
from server.light.shell.switches import Switches
from server.maths.light_direction import direction_error_deg
from server.opencl.device import Device

FRAMES = 8
PATIENCE_S = 10.0

pytestmark = pytest.mark.skipif(not IS_SUPPORTED, reason="no child processes on this system")


def session_of(device: Device) -> tuple[ClientSession, list[object]]:
    source = open_source(f"synthetic:table?frames={FRAMES}&size=160x120&light=1")
    bounds = default_volume(source, range(FRAMES))
    session = ClientSession(device, source.camera, Wishes(volume_m=bounds, voxel_m=default_voxel(bounds), up=source.up))
    return session, [source[index] for index in range(FRAMES)]


@pytest.fixture(scope="module")
def recorded(device: Device) -> list[bytes]:
    """Pickled tasks of a session, with the rays that patches had then."""
    tasks: list[bytes] = []
    original = SolverProcess.solve

    def solve(self: SolverProcess, task: Task) -> Solution | None:
        tasks.append(pickle.dumps(task))
        return original(self, task)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(SolverProcess, "solve", solve)
        session, frames = session_of(device)
        for frame in frames:
            session.process(frame)
        session.close()
    assert len(tasks) >= 3
    return tasks


@pytest.fixture
def tasks(recorded: list[bytes]) -> list[Task]:
    return [pickle.loads(task) for task in recorded]


@pytest.fixture
def solver() -> Iterator[SolverProcess]:
    solver = SolverProcess(Switches())
    yield solver
    solver.close()


def pid_of(solver: SolverProcess) -> int:
    assert solver._child is not None
    return solver._child.pid


def has_ended(pid: int) -> bool:
    """Within PATIENCE_S; a process that nobody has waited for yet has."""
    deadline_s = time.monotonic() + PATIENCE_S
    while time.monotonic() < deadline_s:
        try:
            with open(f"/proc/{pid}/stat", encoding="ascii") as stat:
                if stat.read().rpartition(")")[2].split()[0] == "Z":
                    return True
        except FileNotFoundError:
            return True
        time.sleep(0.02)
    return False


def light_of(solution: Solution | None) -> np.ndarray:
    assert solution is not None
    return solution.estimate(4).sh


def alone(tasks: list[Task]) -> list[Solution]:
    """The solutions in this process."""
    solver = Solver(Switches())
    found = [task.solve(solver) for task in tasks]
    return [solution for solution in found if solution is not None]


def test_it_finds_what_the_solver_finds(solver: SolverProcess, tasks: list[Task], recorded: list[bytes]) -> None:
    """To the bit, although each request brings the rays of new patches alone."""
    expected = alone([pickle.loads(task) for task in recorded])
    for task, one in zip(tasks, expected, strict=True):
        found = solver.solve(task)
        assert found is not None
        np.testing.assert_array_equal(found.near.radiance, one.near.radiance)
        np.testing.assert_array_equal(found.distant.radiance, one.distant.radiance)
        np.testing.assert_array_equal(found.near.covariance, one.near.covariance)


def test_a_solver_begins_anew_where_patches_were_put_together(tasks: list[Task]) -> None:
    """What it knew was of other rows."""
    before, task = tasks[:2]
    task = replace(task, traced=task.patches.used)
    task.patches.side_m *= 2
    went_on, anew = Solver(Switches()), Solver(Switches())
    anew.begin_with(before.solve(went_on).shell)  # type: ignore[union-attr]
    found, expected = task.solve(went_on), task.solve(anew)
    assert found is not None
    assert expected is not None
    np.testing.assert_array_equal(found.near.radiance, expected.near.radiance)
    np.testing.assert_array_equal(found.distant.radiance, expected.distant.radiance)


def test_what_frames_ask_comes_with_the_solution(solver: SolverProcess, tasks: list[Task]) -> None:
    places = np.array([[0.0, 0.0, 1.0]])
    task = replace(tasks[-1], asked=replace(tasks[-1].asked, positions=places))
    rays_of_all = replace(task, traced=task.patches.used)
    solution = solver.solve(rays_of_all)
    assert solution is not None
    assert "dominant_lights" in vars(solution.estimate(task.asked.bands))
    assert len(solution._beyond) == 1


@pytest.mark.parametrize("by", [signal.SIGKILL, signal.SIGSEGV])
def test_one_that_died_is_replaced(
    solver: SolverProcess, tasks: list[Task], caplog: pytest.LogCaptureFixture, by: signal.Signals
) -> None:
    """The new one is sent all rays and begins with the shell of the last."""
    for task in tasks[:-1]:
        solver.solve(task)
    first = pid_of(solver)
    os.kill(first, by)
    assert has_ended(first)
    with caplog.at_level(logging.WARNING, solver_process.__name__):
        found = solver.solve(tasks[-1])
    assert pid_of(solver) != first
    assert found is not None
    expected = alone(tasks)[-1]
    assert found.shell.low == pytest.approx(expected.shell.low)
    assert direction_error_deg(light_of(found), light_of(expected)) < 3
    assert "has ended: another is started" in caplog.text


def test_one_that_dies_at_work_is_replaced(
    solver: SolverProcess, tasks: list[Task], caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    solver.solve(tasks[0])
    first = pid_of(solver)
    original, asked = pickle.dumps, []

    def dumps(value: object, protocol: int | None = None) -> bytes:
        if not asked:  # it dies before it is asked, and after it was seen to live
            asked.append(value)
            os.kill(first, signal.SIGKILL)
            assert has_ended(first)
        return original(value, protocol)

    monkeypatch.setattr(solver_process.pickle, "dumps", dumps)
    with caplog.at_level(logging.WARNING, solver_process.__name__):
        assert solver.solve(tasks[1]) is not None
    assert "another is started" in caplog.text
    assert pid_of(solver) != first


@pytest.mark.parametrize("what", ["no Python", "no job"])
def test_where_none_can_be_started_it_is_solved_here(
    what: str,
    tasks: list[Task],
    recorded: list[bytes],
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
) -> None:
    if what == "no Python":
        monkeypatch.setattr(sys, "executable", "/no/such/python")
    nursery = Nursery(replace(JOB, job="no.such.module:answer"))
    monkeypatch.setattr(solver_process, "_nursery", lambda: nursery)
    solver = SolverProcess(Switches())
    with caplog.at_level(logging.WARNING, solver_process.__name__):
        found = [solver.solve(task) for task in tasks]
    assert caplog.text.count("in the server's own process from now on") == 1
    expected = alone([pickle.loads(task) for task in recorded])
    np.testing.assert_array_equal(light_of(found[-1]), light_of(expected[-1]))
    nursery.stop()


def test_systems_without_children_solve_here(
    tasks: list[Task], recorded: list[bytes], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(solver_process, "IS_SUPPORTED", False)
    solver = SolverProcess(Switches())
    found = [solver.solve(task) for task in tasks]
    np.testing.assert_array_equal(light_of(found[-1]), light_of(alone([pickle.loads(task) for task in recorded])[-1]))
    solver.close()


def test_an_error_of_the_solver_is_told(solver: SolverProcess, tasks: list[Task]) -> None:
    wrong = replace(tasks[0], up=np.zeros(2))
    with pytest.raises(RuntimeError, match=r"could not be solved(.|\n)*Traceback(.|\n)*room_axes"):
        solver.solve(wrong)
    assert solver.solve(tasks[0]) is not None, "the next is solved"


def test_closing_ends_it(solver: SolverProcess, tasks: list[Task]) -> None:
    solver.solve(tasks[0])
    pid = pid_of(solver)
    solver.close()
    assert has_ended(pid)
    with pytest.raises(ChildDied):
        solver.solve(tasks[1])


def test_one_that_nobody_closes_ends_with_its_owner(tasks: list[Task]) -> None:
    solver = SolverProcess(Switches())
    solver.solve(tasks[0])
    pid = pid_of(solver)
    del solver
    gc.collect()
    assert has_ended(pid)


def test_a_closed_session_leaves_none(device: Device) -> None:
    session, frames = session_of(device)
    session.process(frames[0])
    pid = pid_of(session._room.light._model._solver)
    session.close()
    assert has_ended(pid)


def test_a_program_that_ends_leaves_no_process_and_says_nothing() -> None:
    program = (
        "from server.light.shell import solver_process as s; from server.light.shell.switches import Switches;"
        "s.SolverProcess(Switches()); print(s._nursery()._process.pid)"
    )
    command = [sys.executable, "-W", "default::ResourceWarning", "-c", program]
    ended = subprocess.run(command, check=False, capture_output=True, text=True, timeout=60)
    assert (ended.returncode, ended.stderr) == (0, "")
    with pytest.raises(ProcessLookupError):
        os.kill(int(ended.stdout), 0)
