"""The light of one room, from the pictures so far: what they show is summed, and solved beside the frames.

While the light is steady every third frame begins a solution, which a process works out; it is taken over when the
next one begins, ready or waited for, so that the same frames give the same light on any machine. A first picture, a
part of the room that is new and a light that changes are solved within the frame.

Frames of a live camera do not wait, but for a first solution: they take one over as soon as it is ready.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import nullcontext
from dataclasses import dataclass
from functools import partial

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from server.frame_context import FrameContext
from server.input.measure import Measurement
from server.light.arrivals import PendingArrivals, begin_arrivals
from server.light.light_estimation import LightEstimate
from server.light.shell.beside import Beside
from server.light.shell.bright_surface import BrightSurface, TracedEmitters
from server.light.shell.distant import distant_light
from server.light.shell.fade import Fade, Told
from server.light.shell.known_room import KnownRoom
from server.light.shell.patches import Patches, TracedPatches, patch_side_m
from server.light.shell.picture import PatchesInPicture, Seen
from server.light.shell.shell import Shell
from server.light.shell.solution import Solution
from server.light.shell.solver import LEAST_PATCHES, STILL
from server.light.shell.solver_process import Asked, SolverProcess, Task
from server.light.shell.switches import Switches
from server.light.shell.unknowns import Unknowns
from server.light.shell.view import View
from server.opencl.pacing import Pacer
from server.volume.integrate import integrate
from server.volume.volume import Volume

STEADY, CHANGED = 0.25, 0.35
"""Change of log radiance: the median over patches that face one way, then the root mean square over all ways to face,
by the root of how many do. Up to the first value nothing is forgotten (the real kitchen, whose exposure varies, has .23
at most, rooms .03); from the second on everything is (a lamp that goes 45 degrees around a table makes .36)."""
SOLVE_EVERY = 3
"""Frames between two solutions, as long as the light is steady and little of the room is new: evidence is summed in
between. The goal is that a change is followed within three frames."""
LATEST_S = 0.5
"""A live frame waits all the same for a solution that began so long ago, and SOLVE_EVERY frames: on a processor that
has too much to do the light would never be a new one. A person sees light that is later."""
NEW_SHARE = 0.1
"""With this share of new patches, or of frames since the last solution, a frame is solved at once. A solution with this
share of new evidence is told as it is."""
LEAST_FACING = 8
"""Least number of patches that face one way, for a median."""

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class _Tracing:
    """What a solution waits for, and is solved for."""

    volume: Volume
    patches: TracedPatches
    emitters: list[TracedEmitters]
    arrivals: PendingArrivals
    """Of the patches, then of the emitters."""
    view: View
    up: Floats
    """[3] unit, world."""


class RoomModel:
    """Radiance of all that is not scanned surface, with the evidence for it. World axes and metres."""

    def __init__(self, switches: Switches, asked: Callable[[], Asked]) -> None:
        """asked: what frames will ask of the next solution."""
        self._switches, self._asked = switches, asked
        self._patches, self._bright = Patches(), BrightSurface()
        self._solver = SolverProcess(self._switches)
        self._solution: Solution | None = None
        self._next: Beside[Solution | None] | None = None
        self._picture: PatchesInPicture | None = None
        self._tracing: _Tracing | None = None
        self._begun_with: Shell | None = None
        self._waiting = 0
        """Frames since the last solution was begun."""
        self._frames = 0.0
        """That the evidence is worth: fewer once the light has changed."""
        self._kept = 1.0
        """Share of the evidence of the last solution that a change has left."""
        self._is_urgent = False

    @property
    def solution(self) -> Solution | None:
        """The newest; None before anything has been solved."""
        return self._solution

    def begin(self, context: FrameContext) -> None:
        """Let the device gather what a frame shows."""
        self._picture = PatchesInPicture(
            context.engine,
            context.camera,
            context.surface,
            context.scene_radiance,
            context.volume,
            context.volume_from_camera,
        )

    def is_due(self, *, waits: bool) -> bool:
        """Whether the next update takes a solution over, as far as can be told before. waits: as in FrameContext."""
        if not waits and self._solution is not None:
            return self._next is not None and self._is_ready
        return self._waiting + 1 >= SOLVE_EVERY or self._waiting + 1 > NEW_SHARE * (self._frames + 1)

    def update(self, context: FrameContext, up: Floats) -> None:
        """Fold in the frame that was begun; take a solution over, and trace what the next needs, which `finish` begins.

        up: [3] unit, world.
        """
        engine, volume, switches = context.engine, context.volume, self._switches
        assert self._picture is not None
        self.finish()  # what a frame that failed has left
        seen, self._picture = self._picture.seen(), None
        if not seen.count:
            return
        if self._patches.is_empty:
            self._patches = Patches(patch_side_m(seen.positions, volume.voxel_m))
        change = self._change(seen) if switches.memory else 1.0
        if switches.memory and change > 0.0:
            _forget_colors(context, change)
        self._patches.forget(change)
        self._bright.forget(change)
        self._patches.add(seen)
        self._keep_side(volume.voxel_m)
        self._bright.add(seen.bright, seen.positions)
        self._waiting, self._frames = self._waiting + 1, (1 - change) * self._frames + 1
        self._kept *= 1 - change
        self._is_urgent = self._is_urgent or self._must_follow(change)
        waits = context.waits_for_light or self._solution is None
        if not waits and not self._is_ready:
            return
        is_young = self._waiting > NEW_SHARE * self._frames
        is_due = self._is_urgent or is_young or self._waiting >= SOLVE_EVERY
        if is_due or not waits:
            self._take_over(engine.pacer)
        if not is_due or (not self._is_urgent and self._is_still()):
            return
        traced = self._patches.begin_trace(volume.origin_world, self._waiting)
        emitters = self._bright.begin_trace(volume, self._patches, traced.rows)
        arrivals = begin_arrivals(engine, volume, [traced.rays, *(one.rays for one in emitters)])
        solves_now = waits and (self._is_urgent or is_young)
        self._waiting, self._is_urgent = 0, False
        pose = context.volume_from_camera.copy()
        pose[:3, 3] += volume.origin_world
        self._tracing = _Tracing(volume, traced, emitters, arrivals, View.of(context.camera, pose), up)
        if solves_now:
            self.finish()
            self._take_over(engine.pacer)

    def _keep_side(self, voxel_m: float) -> None:
        """Larger patches once the scan has outgrown a table."""
        if self._patches.has_walls:
            return
        side_m = patch_side_m(self._patches.positions[self._patches.seen], voxel_m)
        if side_m > self._patches.side_m:
            self._patches, self._is_urgent = self._patches.grown(side_m), True

    def finish(self) -> None:
        """Begin the solution whose rays are on their way, if there is one."""
        if self._tracing is None:
            return
        tracing, self._tracing = self._tracing, None
        of_patches, *of_emitters = tracing.arrivals.results()
        self._patches.end_trace(tracing.patches, of_patches)
        self._bright.end_trace(tracing.volume, tracing.emitters, of_emitters)
        patches, bright = self._patches.copy(), self._bright.seen_by()
        new = 1 - self._kept + SOLVE_EVERY / self._frames
        fade = Fade(None if new >= NEW_SHARE else Told.by(self._solution), new)
        task = Task(patches, bright, tracing.patches.rows, tracing.view, tracing.up, self._asked(), fade)
        self._next, self._kept = Beside(partial(self._solver.solve, task)), 1.0

    def close(self) -> None:
        """End what is worked out beside the frames."""
        self._solver.close()

    @property
    def _is_ready(self) -> bool:
        """Whether nothing is worked out that a live frame leaves for the next one."""
        if self._next is None or self._next.is_done:
            return True
        return self._waiting >= SOLVE_EVERY and self._next.age_s >= LATEST_S

    def _take_over(self, pacer: Pacer) -> None:
        """The solution that was begun last, waited for: others may use the device meanwhile."""
        if self._next is not None:
            with nullcontext() if self._next.is_done else pacer.aside():
                self._solution = self._next.result() or self._solution
            self._next = None

    def _must_follow(self, change: float) -> bool:
        """Whether the light or the room is another. change: share of the evidence that the frame contradicts."""
        return self._solution is None or change > 0.0 or self._patches.fresh > NEW_SHARE * self.patches

    def _is_still(self) -> bool:
        """Whether what patches show has not changed since the last solution, which has settled."""
        solution = self._solution
        if solution is None or self._patches.fresh > 0:
            return False
        change = solution.change_in(self._patches)
        return solution.behind == 0.0 and max(change, solution.near.step, solution.distant.step) <= STILL

    def estimate(self, bands: int) -> LightEstimate:
        """The light from beyond the scan."""
        return self._solution.estimate(bands) if self._solution else distant_light(Unknowns().solved(), bands)

    def known(self) -> KnownRoom:
        """What it is solved from."""
        return KnownRoom(self._patches.known(), self._solution.shell if self._solution else self._begun_with)

    def resume(self, known: KnownRoom) -> None:
        """Go on from there, with the next frame."""
        self._patches = Patches.resumed(known.patches)
        self._begun_with = known.shell
        self._solver.begin_with(known.shell)

    @property
    def patches(self) -> int:
        """Patches whose rays were traced."""
        return len(self._patches.used)

    def _change(self, seen: Seen) -> float:
        """Share of the evidence that a picture contradicts, from 0 to 1."""
        changes, facing = self._patches.changes(seen)
        counts = np.bincount(facing) if len(facing) else np.zeros(0)
        many = np.flatnonzero(counts >= LEAST_FACING)
        if counts[many].sum() < LEAST_PATCHES:
            return 0.0
        medians = ndimage.median(changes, facing, many)
        change = np.sqrt(np.average(medians**2, weights=np.sqrt(counts[many])))
        return float(np.clip((change - STEADY) / (CHANGED - STEADY), 0.0, 1.0))


def _forget_colors(context: FrameContext, share: float) -> None:
    """The scan's colours lose `share` of their weight; the frame, which the rest hides in its means, counts again."""
    context.volume.forget_colors(share)
    shown = Measurement(context.scene_radiance, context.measurement.depth_m)
    camera, pose = context.camera, context.volume_from_camera
    integrate(context.engine, context.volume, camera, pose, shown, with_shape=False)
