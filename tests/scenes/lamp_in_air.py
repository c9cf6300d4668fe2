"""A room in closed form (shell_room.py) with a round lamp in its air that no picture shows."""

from __future__ import annotations

import numpy as np

from server.light.shell.emitters import Emitters
from server.light.shell.solution import Solution
from server.light.shell.solver import Solver
from server.light.shell.unseen_lamps import AGAIN, BULB_M, YOUNG
from server.light.shell.view import View
from tests.scenes.shell_room import AWAY, NO_EMITTERS, UP, ShellRoom, make_room

RADIANCE = 60.0
"""Of a lamp of BULB_M: 200 times that of what else is not scanned."""
AMBIENT = (0.3, 0.3, 0.3)
ENOUGH = YOUNG + AGAIN + 4
"""Solutions until a lamp is found and has come to its place."""


def lit_room(place: tuple[float, float, float], radiance: float = RADIANCE) -> ShellRoom:
    """A room with a lamp in its air."""
    room = make_room(None, AMBIENT)
    rows = room.patches.used
    away = np.array(place) - room.patches.positions[rows]
    squared = (away**2).sum(axis=1)
    cosine = np.maximum((away * room.patches.normals[rows]).sum(axis=1), 0.0) / np.sqrt(squared)
    without = AMBIENT[0] * room.transport.shares[rows].sum(axis=1) + room.transport.known[rows].mean(axis=1)
    brought = radiance * BULB_M**2 * cosine / squared
    room.patches.logarithms[rows] += np.log1p(brought / without)[:, None]
    return room


def solved(solver: Solver, room: ShellRoom, view: View = AWAY, times: int = ENOUGH) -> Solution:
    """The last of so many solutions."""
    for _ in range(times):
        solution = solver.solve(room.patches, NO_EMITTERS, room.patches.used, view, UP)
    assert solution is not None
    return solution


def lamps_of(solution: Solution) -> Emitters:
    """Those that no picture has shown."""
    return solution.emitters.only(np.flatnonzero(solution.emitters.is_unseen))
