"""Walls and tables go on beyond what was seen of them: how far, the shading shows.

Where no camera looked, the volume is empty, and light would come through the rest of a wall. The planes of what was
seen are continued into what was not, as far beyond each of their sides as explains the pictures best: the extents are
changed one at a time, a few tries a frame, and kept where the light they leave fits clearly better.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass

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


class Continuation:
    """The planes of one session's room."""

    def __init__(self, least_gain: float = LEAST_GAIN) -> None:
        self._least_gain = least_gain
        self.planes: list[PlanePatch] = []
        self._looked: list[PlanePatch] = []
        self._views: deque[tuple[Floats, Floats]] = deque(maxlen=VIEWS)
        self._frames = 0
        self._turn, self._passes, self._was_settled = 0, 0, False
        self._trial: _Trial | None = None
        self._tries, self._share = 0, 0
        self._boxes: list[Floats] = []
        self.explained = 1.0

    @property
    def is_searching(self) -> bool:
        """Whether extents are about to be found for the first time: materials could then pass for their shadows."""
        return self._frames > 0 and not self._was_settled

    @property
    def is_settled(self) -> bool:
        """Whether extents are believed."""
        return self._passes >= SETTLED_PASSES

    def look(self, camera: CameraModel, volume_from_camera: Floats, depth_m: Floats) -> None:
        """Note where a camera looked through the planes' continuations. depth_m: [h, w], 0 = none."""
        self._views.append((inverse_rigid(volume_from_camera), depth_m))
        for plane in self.planes:
            is_new = not any(plane is known for known in self._looked)
            for camera_from_volume, depth in list(self._views) if is_new else [self._views[-1]]:
                plane.empty |= _looked_through(plane, camera, camera_from_volume, depth)
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
        self.explained = trial.misfit / trial.misfit_of_none()
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
    plane: PlanePatch, camera: CameraModel, camera_from_volume: Floats, depth_m: Floats
) -> NDArray[np.bool_]:
    """[rows, cols] cells of a plane's map behind which the camera measured something."""
    at = plane.cell_centers() @ camera_from_volume[:3, :3].T + camera_from_volume[:3, 3]
    z = at[..., 2]
    safe = np.maximum(z, 1e-3)
    u = np.rint(at[..., 0] / safe * camera.fx + camera.cx)
    v = np.rint(at[..., 1] / safe * camera.fy + camera.cy)
    inside = (z > 0.1) & (u >= 0) & (v >= 0) & (u < camera.width) & (v < camera.height)
    measured = np.zeros(z.shape)
    measured[inside] = depth_m[v[inside].astype(np.int64), u[inside].astype(np.int64)]
    return np.asarray(inside & (measured > z + _BEHIND_M))


def spokes() -> Floats:
    """[CELLS, SPOKES, 3] unit directions, four about the middle of each cell."""
    middle = cell_directions()
    side = np.cross(middle, np.eye(3)[np.abs(middle).argmin(axis=1)])
    side /= np.linalg.norm(side, axis=1, keepdims=True)
    other = np.cross(middle, side)
    reach = 0.6 * np.sqrt(CELL_SR / np.pi)
    around = np.stack([middle + reach * (a * side + b * other) for a, b in ((1, 0), (0, 1), (-1, 0), (0, -1))], axis=1)
    return np.asarray(around / np.linalg.norm(around, axis=2, keepdims=True))


class _Trial:
    """Extents and how well the light they leave explains some pools."""

    def __init__(self, planes: list[PlanePatch], judged: Judged, least_gain: float) -> None:
        self._planes = planes
        self._least_gain = least_gain
        self._judged = judged
        self._open = judged.transfer.sum(axis=1)
        self._needed: list[NDArray[np.uint8]] = []
        self._hidden: list[NDArray[np.bool_]] = []
        self.misfit = np.inf

    @property
    def unprepared(self) -> int:
        """Planes without a table of what they would hide; what is tried needs all."""
        return len(self._planes) - len(self._needed)

    def is_of(self, planes: list[PlanePatch]) -> bool:
        """Whether these are the planes, and they are as they were."""
        return self._planes is planes

    def prepare(self) -> None:
        """Make the next plane's table."""
        number = len(self._needed)
        plane = self._planes[number]
        self._needed.append(plane.steps_needed(self._judged.positions, spokes().swapaxes(0, 1).reshape(-1, 3), LEAST_M))
        self._hidden.append(self._hidden_by(number, plane.steps))
        if not self.unprepared:
            self.misfit = self._misfit_of(np.logical_or.reduce(self._hidden))

    def misfit_of_none(self) -> float:
        """The same where no plane goes on."""
        return self._misfit_of(np.zeros_like(self._hidden[0]))

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
            misfit = self._misfit_of(others | hidden)
            allowed = 1 - self._least_gain if step > patch.steps[side] else 1 + 0.2 * self._least_gain
            if misfit < allowed * self.misfit:
                patch.steps[side], self._hidden[plane], self.misfit = step, hidden, misfit
        return max(tried, 1)

    def _candidates(self, now: int, most_m: float) -> Iterator[int]:
        """Other extents of at most `most_m`: all where nothing is known, else the next ones."""
        everything = range(len(STEPS_M)) if now == 0 else (now - 2, now - 1, now + 1, now + 2)
        return (step for step in everything if step != now and 0 <= step < len(STEPS_M) and STEPS_M[step] <= most_m)

    def _hidden_by(self, plane: int, steps: NDArray[np.int64], besides: int | None = None) -> NDArray[np.bool_]:
        """[n, SPOKES * CELLS]; `besides`: a side that is taken to go on without end."""
        hidden = np.ones(self._needed[plane].shape[1:], np.bool_)
        for side in range(SIDES):
            if side != besides:
                hidden &= self._needed[plane][side] <= steps[side]
        return hidden

    def _misfit_of(self, hidden: NDArray[np.bool_]) -> float:
        """What the best light of the judged lobes leaves where directions [n, SPOKES * CELLS] are hidden."""
        judged, codes = self._judged, hidden.view(np.uint8).reshape(len(hidden), SPOKES, -1)
        met = codes.sum(axis=1, dtype=np.uint8)
        open_cells = judged.transfer * (1.0 - met / SPOKES)
        target = judged.target - judged.beyond * (self._open - open_cells.sum(axis=1))
        columns = open_cells @ judged.lobes
        weighted = judged.weights[:, None] * columns
        matrix, vector = weighted.T @ columns, weighted.T @ target
        ridge = RIDGE * max(float(np.trace(matrix)) / len(matrix), 1e-300)
        amounts, _ = solve_nonnegative(matrix + ridge * np.eye(len(matrix)), vector)
        energy = max(float(judged.weights @ target**2), 1e-300)
        left = energy + amounts @ (matrix @ amounts - 2 * vector)
        return max(float(left), 1e-12 * energy)
