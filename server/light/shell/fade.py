"""The light that is told follows the one that is solved by small steps, so that virtual objects do not flicker.

A solution is the minimum of what pictures show so far, and where they tell little of a room's ceiling, neighbouring
cells pass a lamp to each other from one solution to the next. With each, the light that objects take from the shell
changes by a share MOST_CHANGE of it at most, or by as much as is new of the evidence while that is more.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from server.light.shell.shell import CELLS, Shell
from server.light.shell.solution import Solution
from server.light.shell.transport import LAMP
from server.maths.sh import LUMINANCE

MOST_CHANGE = 0.03
"""Of the norm of the light's coefficients. A solution is of three frames, and 1 % is about what people notice
(Weber's law)."""

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Told:
    """What the sources of a solution were told to send."""

    shell: Shell
    hidden: Mapping[int, int]
    """As of Transport."""
    radiance: Floats
    """[k, 3] of its cells and hidden surface."""

    @staticmethod
    def by(solution: Solution | None) -> Told | None:
        """By a solution, if there is one."""
        return Told(solution.shell, solution.hidden, solution.near.radiance) if solution else None


@dataclass(frozen=True)
class Fade:
    """How the next solution is told."""

    before: Told | None
    """None: it is told as it is, since the light is young or another one."""
    new: float
    """Share of the evidence that is new to it."""

    def told(self, solution: Solution, place: Floats) -> Solution:
        """`solution`, or on the way to it from the last one, as seen from `place` [3] (world)."""
        if self.before is None:
            return solution
        held = _with_radiance(solution, _carried(self.before, solution, place))
        light, last = (one.beyond_at(place) @ LUMINANCE for one in (solution, held))
        change = float(np.linalg.norm(light - last)) / max(float(np.linalg.norm(last)), 1e-12)
        share = max(MOST_CHANGE, self.new) / max(change, 1e-12)
        if share >= 1.0:
            return solution
        between = held.near.radiance + share * (solution.near.radiance - held.near.radiance)
        return replace(_with_radiance(solution, between), behind=(1 - share) * change)


def _with_radiance(solution: Solution, radiance: Floats) -> Solution:
    return replace(solution, near=replace(solution.near, radiance=radiance), _beyond={}, _estimates={})


def _carried(before: Told, solution: Solution, place: Floats) -> Floats:
    """[k, 3] what was told of the sources of `solution`; where the shell has moved, in the same directions from
    `place`; of those that are new, what is solved, and nothing of lamps that no picture has shown."""
    radiance = solution.near.radiance.copy()
    radiance[:CELLS] = _turned(before, solution.shell, place)
    for key, column in solution.hidden.items():
        earlier = before.hidden.get(key, len(before.radiance))
        if column < len(radiance) and earlier < len(before.radiance):
            radiance[column] = before.radiance[earlier]
        elif column < len(radiance) and key % 3 == LAMP:
            radiance[column] = 0.0
    return radiance


def _turned(before: Told, shell: Shell, place: Floats) -> Floats:
    """[CELLS, 3]."""
    sent = before.radiance[:CELLS]
    if shell.has_size_of(before.shell):
        return sent
    towards = shell.centers @ shell.axes - place
    towards[np.abs(towards).max(axis=1) < 1e-6] = shell.axes[2]  # of a cell that the place lies in the middle of
    cells, shares = before.shell.exits(np.broadcast_to(place, towards.shape), towards)
    return np.asarray(np.einsum("mc,mcr->mr", shares, sent[cells]))
