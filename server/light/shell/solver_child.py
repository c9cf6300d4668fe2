"""The job of the child that solves one room's light (solver_process.py)."""

from __future__ import annotations

import os
import pickle
import traceback

import numpy as np

from server.children.priority import NICENESS
from server.light.shell.patches import MOST_PATCHES, RAYS
from server.light.shell.solution import Solution
from server.light.shell.solver import Solver
from server.light.shell.solver_process import Failed, Request


class _Room:
    """What the child keeps from request to request."""

    def __init__(self, request: Request) -> None:
        self._solver = Solver(request.switches)
        self._solver.begin_with(request.shell)
        self._arrivals = np.zeros((MOST_PATCHES, RAYS, 4), np.float32)
        os.nice(NICENESS)

    def solution(self, request: Request) -> Solution | None:
        task = request.task
        self._arrivals[task.traced] = task.patches.arrivals
        task.patches.arrivals = self._arrivals
        return task.solve(self._solver)


_rooms: list[_Room] = []
"""One, from the first request on."""


def answer(message: bytes) -> bytes:
    """Pickled Request to pickled Solution, None or Failed."""
    try:
        request = pickle.loads(message)
        assert isinstance(request, Request)
        if request.begins:
            _rooms[:] = [_Room(request)]
        found: Solution | Failed | None = _rooms[0].solution(request)
    except Exception:  # the server raises it again
        found = Failed(traceback.format_exc())
    return pickle.dumps(found, pickle.HIGHEST_PROTOCOL)
