"""Continues planes such as walls and tables beyond their observed parts; shading determines how far.

The volume is empty where no camera looked, so light would pass through the unobserved part of a wall. Observed planes
are therefore extended beyond each side by the distance that explains the images best. Extents are changed one at a
time, a few trials per frame, and kept if the remaining light fits clearly better.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterator
from copy import deepcopy
from dataclasses import dataclass
from functools import cache

import numpy as np
import pyopencl.cltypes as cl_types
from numpy.typing import NDArray

from protocol.frames import CameraModel
from server.maths.lobes import CELL_SR, RIDGE, cell_directions
from server.maths.nonnegative_qp import solve_nonnegative
from server.maths.planes import CELL_M, SIDES, STEPS_M, PlanePatch, find_planes
from server.maths.rigid import inverse_rigid
from server.opencl.engine import Engine, KernelArgument

Floats = NDArray[np.float64]
Singles = NDArray[np.float32]
PlaneArrays = tuple[NDArray[np.float32], NDArray[np.int32], NDArray[np.uint8]]
"""Planes [n, 4, 4], their shapes [n, 4] and all maps, as hide_cells of cell_transfer.cl takes them."""
NO_PLANES: PlaneArrays = (np.zeros((0, 4, 4), np.float32), np.zeros((0, 4), np.int32), np.zeros(1, np.uint8))

SPOKES = 4
"""Directions of a cell that are tried, as in cell_transfer.cl."""
LEAST_M = 0.03
"""A pool does not hide from itself."""
LEAST_GAIN = 0.01
"""A longer extent must leave so much less of the residual's energy; a shorter one may leave a fifth of that more."""
LEAST_GAIN_KNOWN = 0.003
"""The same where the light is known, and so cannot make up for extents."""
FIRST_TRIES = 400
"""Extents tried in each of the first frames, until all have been settled."""
MOST_GROWTH = 1.5
"""Beyond a side a plane goes on for so many times the longer side of what was seen of it, at most."""
TRIES, RESUME_FRAMES, RETRY_FRAMES = 40, 4, 16
"""Extents tried at a time from then on, and how often: while new planes are not settled, and while all are."""
TRIES_OF_A_TABLE = 8
"""What making one plane's table takes, in tries."""
SETTLED_PASSES = 2
"""Times that every side is settled before the extents are believed."""
BELIEVED = 0.9
"""All extents together are believed if they leave less than this share of the residual's energy: what is left of noise
alone some extents always explain a little better."""
VIEWS = 8
"""Earlier frames whose depth a new plane is compared with."""
LEAST_FRAMES = 2
"""Frames before extents are tried: one picture can be explained in too many ways."""
MOST_ROWS = 700
"""Pools that extents are judged by."""
_NEAREST_M = 0.1  # of what a camera sees
_BEHIND_M = 0.05  # a camera that measures so much farther looked through


@dataclass(frozen=True)
class Judged:
    """Pools by which extents are judged, for the albedos and the share of indirect light found so far."""

    positions: Floats
    """[n, 3]."""
    transfer: Floats
    """[n, CELLS] of white surface, nothing continued."""
    lobes: Floats
    """[CELLS, k]."""
    target: Floats
    """[n] radiance over albedo, less what seen surface sends."""
    beyond: Floats
    """[n] radiance that continued planes send."""
    weights: Floats
    """[n]."""


@dataclass(frozen=True)
class KnownPlanes:
    """State of a continuation, for saving and resuming."""

    planes: list[PlanePatch]
    boxes: list[Floats]
    """[4] each, of those believed."""
    frames: int
    turn: int
    passes: int
    was_settled: bool
    explained: float


class Continuation:
    """The planes of one session's room."""

    def __init__(self, least_gain: float = LEAST_GAIN) -> None:
        self._least_gain = least_gain
        self.planes: list[PlanePatch] = []
        self._looked: list[PlanePatch] = []
        self._views: deque[tuple[CameraModel, Floats, Singles]] = deque(maxlen=VIEWS)
        self._frames = 0
        self._turn, self._passes, self._was_settled = 0, 0, False
        self._trial: _Trial | None = None
        self._tries, self._share = 0, 0
        self._boxes: list[Floats] = []
        self.explained = 1.0

    def known(self) -> KnownPlanes:
        """A copy of all but earlier views and a trial under way."""
        planes, boxes = deepcopy(self.planes), list(self._boxes)
        return KnownPlanes(planes, boxes, self._frames, self._turn, self._passes, self._was_settled, self.explained)

    def resume(self, known: KnownPlanes) -> None:
        """Go on with what another one knew; takes it over."""
        self.planes, self._looked, self._boxes = known.planes, list(known.planes), known.boxes
        self._frames, self._turn, self._passes = known.frames, known.turn, known.passes
        self._was_settled, self.explained = known.was_settled, known.explained

    @property
    def is_searching(self) -> bool:
        """Whether extents are about to be found for the first time: materials could then pass for their shadows."""
        return self._frames > 0 and not self._was_settled

    @property
    def is_settled(self) -> bool:
        """Whether extents are believed."""
        return self._passes >= SETTLED_PASSES

    def look(self, camera: CameraModel, volume_from_camera: Floats, depth_m: Singles) -> None:
        """Note where a camera looked through the planes' continuations. depth_m: [h, w], 0 = none."""
        self._views.append((camera, inverse_rigid(volume_from_camera), depth_m))
        for plane in self.planes:
            is_new = not any(plane is known for known in self._looked)
            for view in list(self._views) if is_new else [self._views[-1]]:
                plane.empty |= _looked_through(plane, *view)
        self._looked = list(self.planes)

    def find(self, positions: Floats, normals: Floats) -> None:
        """Look for planes among pools [n, 3] whenever as many frames more have come as there were."""
        self._frames += 1
        if self._frames & (self._frames - 1) == 0 or self._frames % 32 == 0:
            known = len(self.planes)
            self.planes = find_planes(positions, normals, self.planes)
            if len(self.planes) != known:
                self._turn, self._passes = 0, 0

    def try_extents(self, judge: Callable[[], Judged]) -> bool:
        """Try some other extents; whether what is taken for true has changed.

        The extents explain the pictures together, so none is believed before all have been settled twice. But for the
        first ones, what is tried at a time is spread evenly over the frames until the next time: none is a slow one.
        judge: gives the pools to judge by; asked once each time.
        """
        if not self.planes or self._frames < LEAST_FRAMES:
            return False
        wait = 1 if not self._was_settled else RETRY_FRAMES if self.is_settled else RESUME_FRAMES
        if self._trial is None or not self._trial.is_of(self.planes):
            self._trial = None
            if self._frames % wait:
                return False
            self._tries = TRIES if self._was_settled else FIRST_TRIES
            self._trial = _Trial(self.planes, judge(), self._least_gain)
            self._share = -(-(self._trial.unprepared * TRIES_OF_A_TABLE + self._tries) // wait)
        if not self._go_on(self._trial):
            return False
        trial, self._trial = self._trial, None
        if self._turn != 0 or self._passes < SETTLED_PASSES:
            return False
        self._was_settled = True
        self.explained = trial.misfit / trial.misfit_of_none
        believed = self.planes if self.explained < BELIEVED else []
        before, self._boxes = self._boxes, [plane.box for plane in believed]
        return len(before) != len(self._boxes) or not np.array_equal(before, self._boxes)

    def _go_on(self, trial: _Trial) -> bool:
        """A frame's share of a trial; whether it is through."""
        left = self._share
        while trial.unprepared and left > 0:
            trial.prepare()
            left -= TRIES_OF_A_TABLE
        while not trial.unprepared and left > 0:
            tried = trial.settle(*divmod(self._turn, SIDES))
            left, self._tries = left - tried, self._tries - tried
            self._turn = (self._turn + 1) % (SIDES * len(self.planes))
            self._passes += self._turn == 0
            if self._tries <= 0 or (self._turn == 0 and self._passes >= SETTLED_PASSES):
                return True
        return False

    def arrays(self) -> PlaneArrays:
        """What is continued, for the device."""
        if not self._boxes:
            return NO_PLANES
        rows = [
            [
                [*plane.normal, plane.offset_m],
                [*plane.across, plane.corner[0]],
                [*plane.along, plane.corner[1]],
                box,
            ]
            for plane, box in zip(self.planes, self._boxes, strict=False)
        ]
        believed = self.planes[: len(self._boxes)]
        sizes = [plane.empty.size for plane in believed]
        starts = np.concatenate([[0], np.cumsum(sizes)[:-1]])
        shapes = [
            [plane.empty.shape[1], plane.empty.shape[0], start, 0]
            for plane, start in zip(believed, starts, strict=True)
        ]
        maps = np.concatenate([~plane.empty.ravel() for plane in believed])
        return np.array(rows, np.float32), np.array(shapes, np.int32), maps.astype(np.uint8)


def plane_arguments(engine: Engine, name: str, planes: PlaneArrays) -> tuple[KernelArgument, ...]:
    """`planes` on the device, under `name`, in the order of Continued of include/continued.clh."""
    rows, shapes, maps = planes
    count = len(shapes)
    space = engine.workspace
    return (
        count,
        space.upload(name, (rows if count else np.zeros((1, 4, 4), np.float32)).view(cl_types.float4)),
        space.upload(f"{name}_shapes", (shapes if count else np.zeros((1, 4), np.int32)).view(cl_types.int4)),
        space.upload(f"{name}_maps", maps),
        CELL_M,
        LEAST_M,
    )


def _looked_through(
    plane: PlanePatch, camera: CameraModel, camera_from_volume: Floats, depth_m: Singles
) -> NDArray[np.bool_]:
    """[rows, cols] cells of a plane's map behind which the camera measured something, but those that are empty anyhow.
    To float32."""
    rows, cols = plane.empty.shape
    turn = camera_from_volume[:3, :3]
    corner = plane.offset_m * plane.normal + (plane.corner + CELL_M / 2) @ np.stack([plane.across, plane.along])
    first = turn @ corner + camera_from_volume[:3, 3]
    by_col = (np.arange(cols)[:, None] * CELL_M * (turn @ plane.across)).astype(np.float32)
    by_row = (first + np.arange(rows)[:, None] * CELL_M * (turn @ plane.along)).astype(np.float32)
    z = by_row[:, None, 2] + by_col[:, 2]
    per_metre = 1 / np.maximum(z, np.float32(_NEAREST_M))
    u = np.rint((by_row[:, None, 0] + by_col[:, 0]) * per_metre * np.float32(camera.fx) + np.float32(camera.cx))
    v = np.rint((by_row[:, None, 1] + by_col[:, 1]) * per_metre * np.float32(camera.fy) + np.float32(camera.cy))
    inside = (z > _NEAREST_M) & (u >= 0) & (v >= 0) & (u < camera.width) & (v < camera.height)
    cells = np.flatnonzero(inside & ~plane.empty)
    pixels = v.ravel()[cells].astype(np.int64) * camera.width + u.ravel()[cells].astype(np.int64)
    behind = cells[depth_m.ravel()[pixels] > z.ravel()[cells] + np.float32(_BEHIND_M)]
    through = np.zeros((rows, cols), np.bool_)
    through.flat[behind] = True
    return through


@cache
def spokes() -> Floats:
    """[CELLS, SPOKES, 3] unit directions, four about the middle of each cell."""
    middle = cell_directions()
    side = np.cross(middle, np.eye(3)[np.abs(middle).argmin(axis=1)])
    side /= np.linalg.norm(side, axis=1, keepdims=True)
    other = np.cross(middle, side)
    reach = 0.6 * np.sqrt(CELL_SR / np.pi)
    around = np.stack([middle + reach * (a * side + b * other) for a, b in ((1, 0), (0, 1), (-1, 0), (0, -1))], axis=1)
    return np.asarray(around / np.linalg.norm(around, axis=2, keepdims=True))


@dataclass(frozen=True)
class _Judgement:
    """Fit of some extents to pools, with cached data for the next one. Float32."""

    met: NDArray[np.uint8]
    """[pairs] spokes that planes hide."""
    cells: Singles
    """[n, CELLS] transfer that is left."""
    open: Singles
    """[n] its sum."""
    columns: Singles
    """[n, k] shading of white surface under each lobe."""
    lit: NDArray[np.bool_]
    """[k] lobes of the best light."""
    misfit: float
    """What that light leaves."""


class _Trial:
    """Extents and how well the light they leave explains some pools.

    A pair is a pool and a cell that sends it light; of all others nothing can be hidden.
    """

    def __init__(self, planes: list[PlanePatch], judged: Judged, least_gain: float) -> None:
        self._planes = planes
        self._least_gain = least_gain
        self._judged = judged
        self._pools, self._cells = np.nonzero(judged.transfer > 0)
        self._spoke_share = (judged.transfer[self._pools, self._cells] / SPOKES).astype(np.float32)
        self._lobes = judged.lobes.astype(np.float32)
        self._roots = np.sqrt(judged.weights)
        self._needed: list[NDArray[np.uint8]] = []
        self._hidden: list[NDArray[np.bool_]] = []
        cells = judged.transfer.astype(np.float32)
        none_met, lit = np.zeros(len(self._pools), np.uint8), np.zeros(self._lobes.shape[1], np.bool_)
        self._of_none = self._judgement(none_met, cells, cells.sum(axis=1), cells @ self._lobes, lit)
        self._now = self._of_none

    @property
    def unprepared(self) -> int:
        """Planes without a table of what they would hide; what is tried needs all."""
        return len(self._planes) - len(self._needed)

    @property
    def misfit(self) -> float:
        """Of the extents as they are."""
        return self._now.misfit

    @property
    def misfit_of_none(self) -> float:
        """The same where no plane goes on."""
        return self._of_none.misfit

    def is_of(self, planes: list[PlanePatch]) -> bool:
        """Whether these are the planes, and they are as they were."""
        return self._planes is planes

    def prepare(self) -> None:
        """Make the next plane's table."""
        number = len(self._needed)
        plane, origins = self._planes[number], self._judged.positions
        each = [
            plane.steps_needed(origins, directions, self._pools, self._cells, LEAST_M)
            for directions in spokes().swapaxes(0, 1)
        ]
        self._needed.append(np.stack(each, axis=1))
        self._hidden.append(self._hidden_by(number, plane.steps))
        if not self.unprepared:
            self._now = self._judge(np.logical_or.reduce(self._hidden))

    def settle(self, plane: int, side: int) -> int:
        """Give one side of a plane the best of the extents near its own; how many were tried."""
        patch, tried = self._planes[plane], 0
        others = np.zeros_like(self._hidden[plane])
        for k, hidden in enumerate(self._hidden):
            if k != plane:
                others |= hidden
        by_other_sides = self._hidden_by(plane, patch.steps, besides=side)
        for step in self._candidates(int(patch.steps[side]), MOST_GROWTH * patch.longest_m):
            hidden = by_other_sides & (self._needed[plane][side] <= step)
            if not ((hidden ^ self._hidden[plane]) & ~others).any():
                continue
            tried += 1
            judged = self._judge(others | hidden)
            allowed = 1 - self._least_gain if step > patch.steps[side] else 1 + 0.2 * self._least_gain
            if judged.misfit < allowed * self.misfit:
                patch.steps[side], self._hidden[plane], self._now = step, hidden, judged
        return max(tried, 1)

    def _candidates(self, now: int, most_m: float) -> Iterator[int]:
        """Other extents of at most `most_m`: all where nothing is known, else the next ones."""
        everything = range(len(STEPS_M)) if now == 0 else (now - 2, now - 1, now + 1, now + 2)
        return (step for step in everything if step != now and 0 <= step < len(STEPS_M) and STEPS_M[step] <= most_m)

    def _hidden_by(self, plane: int, steps: NDArray[np.int64], besides: int | None = None) -> NDArray[np.bool_]:
        """[SPOKES, pairs]; `besides`: a side that is taken to go on without end."""
        hidden = np.ones(self._needed[plane].shape[1:], np.bool_)
        for side in range(SIDES):
            if side != besides:
                hidden &= self._needed[plane][side] <= steps[side]
        return hidden

    def _judge(self, hidden: NDArray[np.bool_]) -> _Judgement:
        """Of extents that hide [SPOKES, pairs]: what differs from the present ones is made anew."""
        now, met = self._now, hidden.sum(axis=0, dtype=np.uint8)
        changed = np.flatnonzero(met != now.met)
        pools = self._pools[changed]
        rows = pools[np.flatnonzero(np.diff(pools, prepend=-1))]
        cells, left, columns = now.cells.copy(), now.open.copy(), now.columns.copy()
        cells[pools, self._cells[changed]] = self._spoke_share[changed] * (SPOKES - met[changed])
        left[rows] = cells[rows].sum(axis=1)
        columns[rows] = cells[rows] @ self._lobes
        return self._judgement(met, cells, left, columns, now.lit)

    def _judgement(
        self, met: NDArray[np.uint8], cells: Singles, left: Singles, columns: Singles, lit: NDArray[np.bool_]
    ) -> _Judgement:
        """`lit`: guess of the lobes of the best light."""
        judged = self._judged
        hidden = self._of_none.open - left if met.any() else 0.0
        target = (self._roots * (judged.target - judged.beyond * hidden)).astype(np.float32)
        weighted = self._roots.astype(np.float32)[:, None] * columns
        matrix, vector = (weighted.T @ weighted).astype(np.float64), (weighted.T @ target).astype(np.float64)
        ridge = RIDGE * max(float(np.trace(matrix)) / len(matrix), 1e-300)
        matrix.flat[:: len(matrix) + 1] += ridge
        amounts, lit = solve_nonnegative(matrix, vector, lit)
        rest = (target - weighted @ amounts.astype(np.float32)).astype(np.float64)
        energy = max(float(target @ target), 1e-300)
        return _Judgement(met, cells, left, columns, lit, max(float(rest @ rest), 1e-12 * energy))
