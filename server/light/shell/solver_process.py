"""The solver in a child process: neither its arithmetic nor its Python is in the way of the frames.

One child a room, which keeps what it has solved and the rays of all patches; a request brings those that are new. A
child that has died is replaced, and sent everything again. Both ends are this program, so they exchange pickles.
"""

from __future__ import annotations

import atexit
import logging
import pickle
import threading
import weakref
from contextlib import suppress
from copy import copy
from dataclasses import dataclass, replace
from functools import cache

import numpy as np
from numpy.typing import NDArray

from server.children.nursery import ChildDied, JobSpec, Nursery
from server.children.process_pool import IS_SUPPORTED, ChildProcess
from server.light.shell.emitters import EmittersSeen
from server.light.shell.fade import Fade
from server.light.shell.patches import Patches
from server.light.shell.shell import Shell
from server.light.shell.solution import Solution
from server.light.shell.solver import Solver
from server.light.shell.switches import Switches
from server.light.shell.view import View

log = logging.getLogger(__name__)

JOB = JobSpec("server.light.shell.solver_child:answer", memory_mib=4096, timeout_s=60.0, max_answer_bytes=64 << 20)
"""A child takes 0.1 GB, a solution 0.1 to 1 s (the first) and 0.5 MB: the limits stop what has gone wrong."""

NOT_NEEDED = "is not needed any more: the room is closed"

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Asked:
    """What frames ask of every solution and takes long: it is found with it."""

    bands: int
    is_white: bool
    """Of the light's luminance."""
    positions: Floats | None
    """[n, 3] places from which objects see the light beyond the scan, world metres; None: not known."""

    def find(self, solution: Solution) -> None:
        """A solution remembers it."""
        estimate = solution.estimate(self.bands)
        _ = (estimate.whitened if self.is_white else estimate).dominant_lights
        if self.positions is not None:
            solution.beyond(self.positions, self.bands)


@dataclass(frozen=True)
class Task:
    """A solution to find."""

    patches: Patches
    bright: EmittersSeen
    traced: NDArray[np.int64]
    """Rows of the patches whose rays are new."""
    view: View
    """Of the newest frame."""
    up: Floats
    """[3] unit, world."""
    asked: Asked
    fade: Fade

    def solve(self, solver: Solver) -> Solution | None:
        """As it is told, with what is asked of it; None where too few patches are known."""
        solution = solver.solve(self.patches, self.bright, self.traced, self.view, self.up)
        if solution is None:
            return None
        asked = self.asked.positions
        told = self.fade.told(solution, self.view.eye if asked is None else asked.mean(axis=0))
        self.asked.find(told)
        return told

    def without_known_rays(self, known: bool) -> Task:
        """For a child that has the rays of all other patches, if it is `known` to: those of `traced` alone are in it,
        in their order."""
        rows = self.traced if known else self.patches.used
        patches = copy(self.patches)
        patches.arrivals = patches.arrivals[rows]
        return replace(self, patches=patches, traced=rows)


@dataclass(frozen=True)
class Request:
    """To a child."""

    task: Task
    switches: Switches
    begins: bool
    """The child is new; it begins with `shell`."""
    shell: Shell | None


@dataclass(frozen=True)
class Failed:
    """Answer of a child in place of a solution: an error of this program."""

    traceback: str


@cache
def _nursery() -> Nursery:
    """Of all rooms; it ends with this process."""
    nursery = Nursery(JOB)
    atexit.register(nursery.stop)
    return nursery


class SolverProcess:
    """The solver of one room. One thread at a time solves; any closes it."""

    def __init__(self, switches: Switches) -> None:
        """Begins to load what children need, beside the caller."""
        self._switches = switches
        self._shell: Shell | None = None
        self._child: ChildProcess | None = None
        self._solver: Solver | None = None if IS_SUPPORTED else Solver(switches)
        """Of this process, where there are no children."""
        self._is_closed = False
        self._changing = threading.Lock()
        if IS_SUPPORTED:
            with suppress(ChildDied):  # `solve` tells
                _nursery().load()

    def begin_with(self, shell: Shell | None) -> None:
        """Keep the size and place of the shell of an earlier solution."""
        self._shell = shell
        if self._solver is not None:
            self._solver.begin_with(shell)

    def solve(self, task: Task) -> Solution | None:
        """Wait for the solution. Raises RuntimeError with the traceback of an error of the solver, ChildDied once this
        is closed."""
        for _ in range(2):
            if self._solver is not None:
                break
            try:
                return self._asked(task)
            except ChildDied as error:
                self._replace(str(error))
        if self._solver is None:
            log.warning("a room's light is solved in the server's own process from now on")
            self._solver = Solver(self._switches)
            self._solver.begin_with(self._shell)
        return task.solve(self._solver)

    def close(self) -> None:
        """End the child."""
        with self._changing:
            self._is_closed = True
            child = self._child
        if child is not None:
            child.end()

    def _asked(self, task: Task) -> Solution | None:
        if self._child is not None and not self._child.is_alive:
            self._replace("has ended")
        begins = self._child is None
        child = self._child or self._begun()
        request = Request(task.without_known_rays(not begins), self._switches, begins, self._shell)
        answer = pickle.loads(child.ask(pickle.dumps(request, pickle.HIGHEST_PROTOCOL)))
        if isinstance(answer, Failed):
            raise RuntimeError(f"the light of the room could not be solved:\n{answer.traceback}")
        assert answer is None or isinstance(answer, Solution)
        if answer is not None:
            self._shell = answer.shell
        return answer

    def _replace(self, reason: str) -> None:
        if self._is_closed:
            raise ChildDied(NOT_NEEDED)
        log.warning("the process that solves a room's light %s: another is started", reason)
        if self._child is not None:
            self._child.kill()
            self._child = None

    def _begun(self) -> ChildProcess:
        child = ChildProcess(_nursery(), JOB)
        weakref.finalize(self, child.leave)
        with self._changing:
            self._child = child
        if self._is_closed:  # meanwhile
            child.kill()
            raise ChildDied(NOT_NEEDED)
        return child
