"""From patches to a solution, step by step: each begins where the last one ended."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from server.light.shell.bright_surface import EmittersSeen
from server.light.shell.evidence import evidence_of
from server.light.shell.objective import Unknowns, step
from server.light.shell.patches import Patches
from server.light.shell.shell import Shell, closed_sides, shell_around
from server.light.shell.solution import Solution
from server.light.shell.sources import distant_sources, near_sources
from server.light.shell.switches import Switches
from server.light.shell.transport import Transport
from server.maths.lobes import LOBES

MOST_STEPS = 16
"""Most Gauss-Newton steps of a solution. Another follows while the last one changed what patches receive by more than
MOVED, or less where what they show hardly changes, down to STILL."""
MOVED, DISTANT_MOVED, NEW_MOVED = 0.02, 0.05, 0.01
"""Change of a logarithm; the second value holds for the light from beyond the scan, both while the light is steady; the
third for a light that is new."""
FIRST_SHARE, DISTANT_SHARE, FIRST_SOLUTIONS = 0.5, 0.2, 10
"""Of each step for the light from beyond the scan, which pictures tell little of: in so many first solutions, later.
With whole steps half a voxel's shift turns the real kitchen's light by 13 degrees instead of 8; with .3 at first, what
four far views of a table show is not caught up with (12 degrees off instead of 10)."""
STILL = 0.005
"""What patches show has not changed while the root mean square of the change of its logarithm is at most this, and a
solution has settled while its last step's is: half a per cent is less than a code of a picture."""
CHROMA_MOVED = 0.05
"""While a step changes what patches receive by no more than this, the light keeps the colours that a solution's first
step found: they follow the level slowly, and take a third of a step's time."""
LEAST_PATCHES = 12
"""With fewer patches there is no solution."""

Floats = NDArray[np.float64]


class Solver:
    """Used by one thread at a time."""

    def __init__(self, switches: Switches) -> None:
        self._switches = switches
        self._shell: Shell | None = None
        self._begin_anew(0.0)

    def begin_with(self, shell: Shell | None) -> None:
        """Keep the size and place of the shell of an earlier solution."""
        self._shell = shell

    def _begin_anew(self, side_m: float) -> None:
        """Forget all that belongs to rows of patches."""
        self._transport = Transport()
        self._near, self._distant = Unknowns(), Unknowns()
        self._last: Solution | None = None
        self._side_m = side_m
        self._solutions = 0

    def solve(
        self, patches: Patches, bright: EmittersSeen, traced: NDArray[np.int64], camera: Floats, up: Floats
    ) -> Solution | None:
        """The next solution; None where too few patches are known.

        traced: rows of the patches whose rays are new. camera: [3] world metres; up: [3] unit, world.
        """
        rows, switches = patches.used, self._switches
        if len(rows) < LEAST_PATCHES:
            return None
        positions, normals = patches.positions[rows], patches.normals[rows]
        side_m, has_walls = patches.side_m, patches.has_walls
        if side_m != self._side_m:  # they were put together
            self._begin_anew(side_m)
        self._shell = shell = shell_around(
            positions, normals, camera[None], up, side_m, self._shell, has_walls=has_walls
        )
        self._transport.update(patches, bright, traced, shell)
        closed = closed_sides(positions, normals, shell.axes, side_m, has_walls=has_walls)
        evidence = evidence_of(patches, rows, switches)
        near = near_sources(self._transport, shell, patches, evidence.rows)
        distant = distant_sources(
            self._transport, closed, shell.axes[2], evidence.rows, with_indirect=switches.indirect
        )
        first = patches.outdated if self._near.known > 0 and switches.memory else 1.0
        share = FIRST_SHARE if self._solutions < FIRST_SOLUTIONS else DISTANT_SHARE
        self._distant.most_relaxation = share ** (1 - patches.outdated)
        self._solutions += 1
        change = self._last.change_in(patches) if self._last else np.inf
        moved = MOVED * float(np.clip(change / STILL, STILL / MOVED, 1.0))
        for unknowns, sources, steady in ((self._near, near, moved), (self._distant, distant, DISTANT_MOVED)):
            settled = steady ** (1 - first) * NEW_MOVED**first
            unknowns.relaxation = max(unknowns.relaxation, patches.outdated)
            for number in range(MOST_STEPS):
                step(unknowns, evidence, sources, switches, with_chroma=number == 0 or unknowns.step > CHROMA_MOVED)
                if unknowns.step < settled:
                    break
        hidden, shown = dict(self._transport.hidden), patches.logarithms[rows]
        solved = self._near.solved(), self._distant.solved(LOBES)
        self._last = Solution(shell, hidden, bright.emitters, *solved, rows, shown)
        return self._last
