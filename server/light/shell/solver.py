"""From patches to a solution, step by step: each begins where the last one ended."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from server.light.shell.emitters import EmittersSeen
from server.light.shell.evidence import Evidence, evidence_of
from server.light.shell.objective import Linear, received, step
from server.light.shell.patches import GRIDS, Patches
from server.light.shell.shell import Shell, closed_sides, room_axes, shell_around
from server.light.shell.solution import Solution
from server.light.shell.sources import Sources, distant_sources, near_sources
from server.light.shell.switches import Switches
from server.light.shell.transport import Transport, columns_of, lamp_keys
from server.light.shell.unknowns import Unknowns
from server.light.shell.unseen_lamps import Room, UnseenLamps
from server.light.shell.view import View
from server.light.shell.weights import CONTACT_NOISE
from server.maths.lobes import LOBES

MOST_STEPS = 16
"""Most Gauss-Newton steps of a solution. Another follows while the last one changed what patches receive by more than
MOVED, or less where what they show hardly changes, down to STILL."""
MOVED, NEW_MOVED = 0.02, 0.01
"""Change of a logarithm while the light is steady, and of a light that is new."""
DISTANT_STEPS, DISTANT_SHARE = 2, 0.5
"""The light from beyond the scan, of which pictures tell little, takes so many steps a solution, and of each this
share: a new one keeps a fourth of its prior. After twelve, half a voxel's shift turns the light that one picture of the
real kitchen shows by 12 degrees instead of 5."""
MOST_MISSED = 4
"""A solver that is new does the work of so many solutions at most, and of as many as there were frames: one that goes
on where a room was saved, or in place of a process that died, has nearly the light that one has which was there."""
FORGOTTEN = 0.05
"""Share of the way back to its prior at which each of its solutions begins, all of it where the light is another: what
pictures tell little of does not stay as the first of them had it. In steps alone, where 40 lead to the minimum, the
light of the real kitchen was 4 to 14 degrees from it in all frames."""
STILL = 0.005
"""What patches show has not changed while the root mean square of the change of its logarithm is at most this, and a
solution has settled while its last step's is: half a per cent is less than a code of a picture."""
CHROMA_MOVED = 0.05
"""While a step changes what patches receive by no more than this, the light keeps the colours that a solution's first
step found: they follow the level slowly, and take a third of a step's time."""
ANOTHER = 0.5
"""Where so much of the evidence is outdated, the light is another one: lamps are looked for anew."""
LEAST_PATCHES = 10 * GRIDS
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
        self._transport, self._lamps = Transport(), UnseenLamps()
        self._near, self._distant = Unknowns(), Unknowns(most_relaxation=DISTANT_SHARE)
        self._last: Solution | None = None
        self._side_m = side_m

    def solve(
        self, patches: Patches, bright: EmittersSeen, traced: NDArray[np.int64], view: View, up: Floats
    ) -> Solution | None:
        """The next solution; None where too few patches are known.

        traced: rows of the patches whose rays are new. view: of the newest frame; up: [3] unit, world.
        """
        rows, switches = patches.used, self._switches
        if len(rows) < LEAST_PATCHES:
            return None
        positions, normals = patches.positions[rows], patches.normals[rows]
        side_m, has_walls = patches.side_m, patches.has_walls
        if side_m != self._side_m:  # they were put together
            self._begin_anew(side_m)
        axes = room_axes(normals, up, self._shell)
        closed = closed_sides(positions, normals, axes, patches.area_m2, has_walls=has_walls)
        self._shell = shell = shell_around(positions, view.eye[None], axes, closed, self._shell)
        finds_lamps = switches.albedos and has_walls
        if finds_lamps:
            if patches.outdated >= ANOTHER:
                self._lamps.forget()
            self._lamps.note(view, shell, patches)
            bright = self._lamps.beside(bright, patches)
        self._transport.update(patches, bright, traced, shell)
        evidence = evidence_of(patches, rows, switches)
        near = near_sources(self._transport, shell, patches, evidence.rows)
        distant = distant_sources(
            self._transport, closed, shell.axes[2], evidence.rows, with_indirect=switches.indirect
        )
        first = patches.outdated if self._near.known > 0 and switches.memory else 1.0
        change = self._last.change_in(patches) if self._last else np.inf
        moved = MOVED * float(np.clip(change / STILL, STILL / MOVED, 1.0))
        here = self._solve_near(evidence, near, moved ** (1 - first) * NEW_MOVED**first, patches.outdated)
        if finds_lamps:
            self._lamps.follow(Room(self._near, here, patches, evidence.rows, shell), self._sent_by_lamps())
        contact = CONTACT_NOISE**2 * self._transport.near[evidence.rows]
        frames = int(patches.weights[rows].max()) if self._distant.known == 0 else 1
        self._solve_distant(evidence.with_noise(contact), distant, patches.outdated, min(max(frames, 1), MOST_MISSED))
        hidden, shown = dict(self._transport.hidden), patches.logarithms[rows]
        solved = self._near.solved(), self._distant.solved(LOBES)
        self._last = Solution(shell, hidden, bright.emitters, *solved, rows, shown)
        return self._last

    def _solve_near(self, evidence: Evidence, sources: Sources, settled: float, outdated: float) -> Linear:
        """Steps until one changes what patches receive by less than `settled`; the objective before the last."""
        unknowns = self._near
        unknowns.relaxation = max(unknowns.relaxation, outdated)
        for number in range(MOST_STEPS):
            with_chroma = number == 0 or unknowns.step > CHROMA_MOVED
            here = step(unknowns, evidence, sources, self._switches, with_chroma=with_chroma)
            if unknowns.step < settled:
                break
        return here

    def _sent_by_lamps(self) -> dict[int, float]:
        """Radiance of the lamps that were not seen, by their numbers."""
        columns = columns_of(self._transport.hidden, lamp_keys([*self._lamps.centers]))
        sent = np.exp(np.log(self._near.radiance[columns]).mean(axis=1))
        return dict(zip(self._lamps.centers, sent.tolist(), strict=True))

    def _solve_distant(self, evidence: Evidence, sources: Sources, outdated: float, times: int) -> None:
        """DISTANT_STEPS, from nearer to the prior; so many times. Their step becomes the change from the last one."""
        unknowns = self._distant
        before = received(unknowns, sources)
        for number in range(times * DISTANT_STEPS):
            is_first = number % DISTANT_STEPS == 0
            if is_first:
                unknowns.forget(FORGOTTEN ** (1 - outdated), sources, self._switches)
            step(unknowns, evidence, sources, self._switches, with_chroma=is_first)
        unknowns.step = float(np.sqrt(np.mean((received(unknowns, sources) - before) ** 2)))
