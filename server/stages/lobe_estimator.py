"""Light estimation (thesis 5.1.3) as it is in a room: non-negative, from everywhere, off surfaces of unknown albedo.

Model: radiance = albedo (visible sky + what surfaces send). The pools of the last frames are kept; their albedos and
the light are found in turn, each given the other, a few rounds a frame. Luminance comes first. A colour channel is
drawn to a multiple of it, as surfaces have more colour than light: without evidence for coloured light, shadows are
neutral. How fast earlier frames are forgotten is what would have predicted the newest one best.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pyopencl.array as cl_array
from numpy.typing import NDArray

from protocol.frames import CameraModel
from server.maths.lobes import (
    CELLS,
    WIDTHS_DEG,
    LobeFit,
    lobe_family,
)
from server.maths.sh import LUMINANCE
from server.maths.surfaces import Albedos, Surfaces, one_albedo
from server.opencl.engine import Engine
from server.stages.cell_light import solve_cells
from server.stages.cell_transfer import PoolGrid, Pools, PoolWindow, pool_grid
from server.stages.continuation import MOST_ROWS, NO_PLANES, Continuation, Judged
from server.stages.indirect import Indirect
from server.stages.light_estimation import ASSUMED_ALBEDO, LightEstimate
from server.stages.light_model import (
    COLOR_PULL,
    Columns,
    Frame,
    LightModel,
    Rows,
    Solution,
    is_of_one_color,
    misfit_of,
    rows_of,
    solve_amounts,
    system_of,
    weights_of,
    with_colors,
)
from server.stages.radiance_transfer import Directions, Transfer
from server.stages.raycast import Surface

Floats = NDArray[np.float64]

SLOTS = 10
"""Frames that are kept."""
MEMORIES = (0.95, 0.8, 0.5, 0.1)
"""What may remain of a frame's weight a frame later."""
WORTH_FORGETTING = 1.5
"""Frames are forgotten sooner only where the longest memory's misfits are so many times the least, over some frames."""
UNDERSTOOD = 0.8
"""Earlier estimates do not count once the room's extents leave less than this share of what they left."""
AVERAGE = 0.15
"""Share that a new estimate has in the mean while the light is steady."""
CHANGE = 3.0
"""The light has changed if the frame's misfit under it is this many times what the frame's own best fit leaves."""
CHANGED_WEIGHT = 0.03
"""What then remains of earlier frames."""
LEAST_WEIGHT = 8.0
"""Pools without which a frame says nothing."""
ROUNDS, FIRST_ROUNDS, COLOR_ROUNDS = 4, 16, 4
"""Of light and albedos in turn: in a frame, in the first and after a change, and how many of those by colour alone."""
JUDGED_WIDTH_DEG = 25.0
"""Of the lobes that extents are judged with: a light of wide lobes alone would have planes make its edges."""
_SCORE_MEMORY = 0.8  # so a lasting excess of a tenth adds up to a half
_LEAST_MISFIT = 1e-4  # of the frame's energy: below it a ratio of misfits says nothing


class LobeEstimator:
    """The running estimate of one session's light."""

    def __init__(
        self,
        engine: Engine,
        bands: int,
        model: LightModel | None = None,
        continuation: Continuation | None = None,
        known: Floats | None = None,
    ) -> None:
        """`known`: radiances [CELLS] of the light, if only its brightness, albedos and the room are to be found."""
        self._engine = engine
        self._known = known
        self._family = lobe_family(WIDTHS_DEG[0]) if known is None else known[:, None] / max(float(known.sum()), 1e-12)
        self._model = model or LightModel()
        self.continuation = continuation
        self._bands = bands
        self._window: PoolWindow | None = None
        self._frames: dict[int, Frame] = {}
        self._next = 0
        self._surfaces = Surfaces()
        self._solution: Solution | None = None
        self._one_color = True
        self._memory = 0
        self._steady, self._is_fresh = 0, True
        self._scores = np.zeros(len(MEMORIES))
        self._predictions: list[Floats] = []
        self._last: tuple[Rows, Albedos, Floats] | None = None
        self.light: LobeFit | None = None
        self.materials = 0
        self._estimate = LightEstimate(np.zeros((bands * bands, 3)), None, float("inf"), valid=False)

    def estimate(self) -> LightEstimate:
        """The light as it stands."""
        return self._estimate

    def update(
        self,
        surface: Surface,
        camera: CameraModel,
        transfer: Transfer,
        rays: Directions,
        observed: cl_array.Array,
        indirect: Indirect,
        voxel_m: float,
        volume_from_camera: Floats,
        depth_m: cl_array.Array,
    ) -> LightEstimate:
        """Fold one frame in and solve. A frame that saw nothing leaves the estimate as it was.

        observed: [rows, cols] float4 of the samples, w = 1 usable; depth_m: [h, w] as measured.
        """
        window = self._window_for(pool_grid(transfer))
        slot = self._next
        self._frames.pop(slot, None)
        pools = window.pool(slot, surface, camera, transfer, rays, observed, indirect, voxel_m)
        if pools.weights.sum() < LEAST_WEIGHT or not (pools.seen > 0).any():
            return self._estimate
        self._next = (slot + 1) % SLOTS
        window.hide([slot], self.continuation.arrays() if self.continuation else NO_PLANES)
        was_searching = self.continuation is not None and self.continuation.is_searching
        estimate = self.fold(slot, pools)
        if self.continuation:
            self._look_around(self.continuation, camera, volume_from_camera, self._engine.download(depth_m))
            before = self.continuation.explained
            if self.continuation.try_extents(self._judged()):
                self._is_fresh |= self.continuation.explained < UNDERSTOOD * before
                window.hide(self._frames, self.continuation.arrays())
                for held, frame in self._frames.items():
                    frame.columns = window.shading(held, self._lobes_and_all())
                estimate = self._refresh(slot, ROUNDS)
            self._is_fresh |= was_searching and not self.continuation.is_searching
        self._estimate = self._averaged(estimate)
        return self._estimate

    def _averaged(self, estimate: LightEstimate) -> LightEstimate:
        """P3 (thesis 5.4): the mean of the last estimates, as long as the light is steady and understood alike."""
        self._steady = 1 if self._is_fresh or not self._model.memory else self._steady + 1
        rate = max(1.0 / self._steady, AVERAGE)
        self._is_fresh = False
        return replace(estimate, sh=self._estimate.sh + rate * (estimate.sh - self._estimate.sh))

    def fold(self, slot: int, pools: Pools) -> LightEstimate:
        """The light with `pools`, whose transfer lies in `slot` of the window, not averaged."""
        assert self._window is not None
        columns = self._window.shading(slot, self._lobes_and_all())
        newest = Frame(pools, columns)
        with self._engine.profile.host():
            rounds = self._forget(newest)
        self._is_fresh |= rounds == FIRST_ROUNDS or self._memory > 0
        self._frames[slot] = newest
        return self._refresh(slot, rounds)

    def _look_around(self, continuation: Continuation, camera: CameraModel, pose: Floats, depth_m: Columns) -> None:
        """Find planes in what is seen, and what of them cannot be."""
        used = [frame.pools.weights > 0 for frame in self._frames.values()]
        positions = [frame.pools.positions[own] for frame, own in zip(self._frames.values(), used, strict=True)]
        normals = [frame.pools.normals[own] for frame, own in zip(self._frames.values(), used, strict=True)]
        with self._engine.profile.host():
            continuation.find(np.concatenate(positions), np.concatenate(normals))
            continuation.look(camera, pose, depth_m.astype(np.float64))

    def _judged(self) -> Judged:
        """Some pools of the window, as the albedos found last have them."""
        assert self._window is not None
        assert self._last is not None
        rows, albedos, weights = self._last
        some = np.arange(0, len(rows.seen), max(1, -(-len(rows.seen) // MOST_ROWS)))
        raw = self._engine.download(self._window.raw)[rows.slots[some], rows.places[some]].astype(np.float64)
        mean_albedo = self._solution.mean_albedo if self._solution else ASSUMED_ALBEDO
        _, target, scaled = system_of(rows, albedos, weights)
        pools = [
            (self._frames[slot].pools, place) for slot, place in zip(rows.slots[some], rows.places[some], strict=True)
        ]
        sent = np.array([frame.sent[place] @ LUMINANCE for frame, place in pools])
        return Judged(
            positions=np.array([frame.positions[place] for frame, place in pools]),
            transfer=raw,
            lobes=self._judged_lobes(),
            target=target[some] - mean_albedo * sent,
            beyond=mean_albedo * np.array([frame.beyond @ LUMINANCE for frame, _ in pools]),
            weights=scaled[some],
        )

    def _judged_lobes(self) -> Floats:
        if self._known is not None:
            return self._family
        return lobe_family(min(JUDGED_WIDTH_DEG, self.light.width_deg if self.light else JUDGED_WIDTH_DEG))

    def _lobes_and_all(self) -> Floats:
        """[CELLS, lobes + 1] the widest family, and a sky of radiance 1 all over."""
        return np.column_stack([self._family, np.ones(CELLS)])

    def _refresh(self, slot: int, rounds: int) -> LightEstimate:
        """Light and albedos from the window, whose newest frame lies in `slot`."""
        rows = rows_of(self._frames, self._model.normals)
        with self._engine.profile.host():
            albedos, weights = self._in_turn(rows, rounds)
            self._predictions = self._predict(albedos, weights, rows)
        self.materials = albedos.count
        self._last = (rows, albedos, weights)
        assert self._window is not None
        assert self._solution is not None
        if self._known is not None:
            return self._estimate
        self.light, estimate = solve_cells(
            self._window,
            rows,
            albedos,
            weights,
            self._solution,
            slot,
            self._bands,
            albedo_known=not self._model.albedos,
        )
        return estimate

    def _window_for(self, grid: PoolGrid) -> PoolWindow:
        """The window, empty where pictures are cut otherwise than before."""
        if self._window is None or self._window.grid != grid:
            self._window = PoolWindow(self._engine, grid, SLOTS)
            self._frames, self._next, self._predictions = {}, 0, []
        return self._window

    def _forget(self, newest: Frame) -> int:
        """Weigh earlier frames by what the newest one says of them; how many rounds to take."""
        if self._solution is None or not self._frames:
            return FIRST_ROUNDS
        rows = rows_of({0: newest}, self._model.normals)
        albedos, weights = (
            self._albedos(rows, self._solution, materials=True),
            weights_of(rows, None, None, outliers=False),
        )
        columns, target, scaled = system_of(rows, albedos, weights)
        energy = float(scaled @ target**2)
        own = misfit_of(columns, target, scaled, solve_amounts(columns, target, scaled)) + _LEAST_MISFIT * energy
        misfits = np.array([misfit_of(columns, target, scaled, x) for x in self._predictions])
        if len(misfits):
            self._scores = _SCORE_MEMORY * self._scores + np.log(misfits + _LEAST_MISFIT * energy)
        known = np.append(self._solution.amounts, self._solution.mean_albedo)
        changed = misfit_of(columns, target, scaled, known) > CHANGE * own
        self._memory = int(np.flatnonzero(self._scores <= self._scores.min() + np.log(WORTH_FORGETTING))[0])
        memory = MEMORIES[self._memory]
        for frame in self._frames.values():
            frame.keep *= (CHANGED_WEIGHT if changed else memory) if self._model.memory else 0.0
        if changed:
            self._scores = np.zeros(len(MEMORIES))
        return FIRST_ROUNDS if changed else ROUNDS

    def _in_turn(self, rows: Rows, rounds: int) -> tuple[Albedos, Floats]:
        """Light and albedos given each other, `rounds` times; leaves the light in `_solution`."""
        if not self._model.albedos:
            rounds = min(rounds, 2)
        solution, first = self._solution, rounds == FIRST_ROUNDS
        albedos, weights = one_albedo(len(rows.seen)), weights_of(rows, None, None, outliers=False)
        self._one_color = not self._model.albedos or is_of_one_color(rows)
        pull = COLOR_PULL if self._one_color else None
        for number in range(rounds):
            if solution is not None:
                albedos = self._albedos(rows, solution, materials=not first or number > COLOR_ROUNDS)
                weights = weights_of(rows, solution, albedos, outliers=self._model.outliers)
            columns, target, scaled = system_of(rows, albedos, weights)
            amounts = solve_amounts(columns, target, scaled)
            solution = with_colors(rows, albedos, weights, amounts[:-1], float(amounts[-1]), pull)
        self._solution = solution
        return albedos, weights

    def _albedos(self, rows: Rows, solution: Solution, *, materials: bool) -> Albedos:
        if not self._model.albedos:
            return one_albedo(len(rows.seen))
        materials = materials and (self.continuation is None or not self.continuation.is_searching)
        shading = rows.columns @ solution.colors + solution.mean_albedo * rows.sent
        return self._surfaces.albedos(rows.seen, shading, rows.weights, materials=materials, one_color=self._one_color)

    def _predict(self, albedos: Albedos, weights: Floats, rows: Rows) -> list[Floats]:
        """For each memory, the light that all frames so far make under it."""
        columns, target, scaled = system_of(rows, albedos, weights)
        order = sorted(self._frames, key=lambda s: (s - self._next) % SLOTS)  # oldest first
        age = {slot: len(order) - 1 - place for place, slot in enumerate(order)}
        keep = np.array([self._frames[slot].keep for slot in rows.slots])
        ages = np.array([age[slot] for slot in rows.slots])
        return [solve_amounts(columns, target, scaled / keep * memory**ages) for memory in MEMORIES]
