"""Light estimation in rooms (extends thesis 5.1.3): non-negative light from all directions, unknown albedo.

Model: radiance = albedo (visible sky + what surfaces send). The pools of some frames are kept (frame_window.py); their
albedos and the light are found in turn, each given the other, a few rounds a frame. Luminance comes first. A colour
channel is drawn to a multiple of it, as surfaces have more colour than light: without evidence for coloured light,
shadows are neutral. Frames count until surface that they share with the newest says that the light has changed.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import pyopencl.array as cl_array
from numpy.typing import NDArray

from protocol.frames import CameraModel
from server.light.cell_light import solve_cells
from server.light.cell_transfer import PoolGrid, Pools, PoolWindow, pool_grid
from server.light.continuation import MOST_ROWS, NO_PLANES, Continuation, Judged, KnownPlanes
from server.light.frame_window import SLOTS, FrameWindow
from server.light.light_estimation import ASSUMED_ALBEDO, LightEstimate
from server.light.light_model import (
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
    sums_of,
    system_of,
    weights_of,
    with_colors,
)
from server.maths.light_change import Shot
from server.maths.lobes import (
    CELLS,
    WIDTHS_DEG,
    LobeFit,
    lobe_family,
)
from server.maths.sh import LUMINANCE
from server.maths.surfaces import Albedos, Surfaces, one_albedo
from server.opencl.engine import Engine
from server.transfer.indirect import Indirect
from server.transfer.radiance_transfer import Directions, Transfer
from server.volume.raycast import Surface

Floats = NDArray[np.float64]

UNDERSTOOD = 0.8
"""Of a young session: its earlier estimates do not count once the room's extents leave less than this share of what
they left. Later a mind is changed slowly."""
YOUNG = 12
"""Frames."""
HOLD = 1.0
"""How much a light that has long been steady is held, over what pools say of it: what these do not tell stays as it
was, while new views turn it slowly."""
LONG = 30
"""Frames."""
AVERAGE = 0.1
"""Share that a new estimate has in the mean while the light is steady."""
CHANGE = 3.0
"""Where a frame shares no surface with another, the light has changed if its misfit is this many times what its own
best fit leaves."""
CHANGED_WEIGHT = 0.03
"""What then remains of earlier frames."""
SOON = 3
"""A light that changed fewer frames ago is found anew; the mean goes back a third of the way to the change."""
LEAST_WEIGHT = 8.0
"""Pools without which a frame says nothing."""
ROUNDS, FIRST_ROUNDS, COLOR_ROUNDS = 4, 16, 4
"""Of light and albedos in turn: in a frame, in the first and after a change, and how many of those by colour alone."""
STEADY_ROUNDS = 2
"""In a frame of a light that has been steady for `YOUNG` frames: what is left to do, the next frames do."""
JUDGED_WIDTH_DEG = 25.0
"""Of the lobes that extents are judged with: a light of wide lobes alone would have planes make its edges."""
_LEAST_MISFIT = 1e-4  # of the frame's energy: below it a ratio of misfits says nothing


@dataclass(frozen=True)
class KnownLight:
    """State of an estimator without its frames, for saving and resuming."""

    estimate: LightEstimate
    light: LobeFit | None
    solution: Solution | None
    mean: Floats | None
    """[lobes]."""
    surface_colors: Floats
    one_color: bool
    steady: int
    frames: int
    planes: KnownPlanes | None


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
        self._kept = FrameWindow()
        self._surfaces = Surfaces()
        self._solution: Solution | None = None
        self._one_color = True
        self._steady = 0
        self._mean: Floats | None = None
        self._last: tuple[Rows, Albedos, Floats] | None = None
        self._lit: dict[float, NDArray[np.bool_]] = {}
        self.light: LobeFit | None = None
        self.materials = 0
        self._estimate = LightEstimate(np.zeros((bands * bands, 3)), None, float("inf"), valid=False)

    def estimate(self) -> LightEstimate:
        """The light as it stands."""
        return self._estimate

    @property
    def steady(self) -> int:
        """Frames that the mean goes back; fewer than before where the light has changed."""
        return self._steady

    def known(self) -> KnownLight:
        """All but the frames of the window."""
        return KnownLight(
            self._estimate,
            self.light,
            self._solution,
            self._mean,
            self._surfaces.colors,
            self._one_color,
            self._steady,
            self._kept.count,
            self.continuation.known() if self.continuation else None,
        )

    def resume(self, known: KnownLight) -> None:
        """Go on with what another one knew, of as many bands; nothing of it where its lobes were others."""
        lobes = self._family.shape[1]
        if known.solution is not None and len(known.solution.amounts) != lobes:
            return
        self._estimate, self.light, self._solution, self._mean = known.estimate, known.light, known.solution, known.mean
        self._surfaces.colors, self._one_color, self._steady = known.surface_colors, known.one_color, known.steady
        self._kept = FrameWindow(known.frames)
        if self.continuation and known.planes:
            self.continuation.resume(known.planes)

    def update(
        self,
        surface: Surface,
        camera: CameraModel,
        transfer: Transfer,
        rays: Directions,
        observed: cl_array.Array,
        indirect: Indirect,
        voxel_m: float,
        shot: Shot,
        depth_m: cl_array.Array,
    ) -> LightEstimate:
        """Fold one frame in and solve. A frame that saw nothing leaves the estimate as it was.

        observed: [rows, cols] float4 of the samples, w = 1 usable; depth_m: [h, w] as measured.
        """
        grid = pool_grid(transfer)
        window = self._window_for(grid)
        slot = self._kept.free_slot()
        pools = window.pool(slot, grid, surface, camera, transfer, rays, observed, indirect, voxel_m)
        if pools.weights.sum() < LEAST_WEIGHT or not (pools.seen > 0).any():
            return self._estimate
        window.hide([slot], self.continuation.arrays() if self.continuation else NO_PLANES)
        was_searching = self.continuation is not None and self.continuation.is_searching
        estimate = self.fold(slot, pools, shot)
        if self.continuation:
            self._look_around(self.continuation, camera, shot.volume_from_camera, self._engine.download(depth_m))
            before = self.continuation.explained
            if self.continuation.try_extents(self._judged):
                self._understand(anew=self.continuation.explained < UNDERSTOOD * before)
                window.hide(self._kept.frames, self.continuation.arrays())
                for held, frame in self._kept.frames.items():
                    frame.columns = self._columns(held, frame.pools)
                estimate = self._refresh(slot, ROUNDS)
            self._understand(anew=was_searching and not self.continuation.is_searching)
        self._estimate = self._averaged(estimate)
        return self._estimate

    def _understand(self, *, anew: bool) -> None:
        """Where the room is seen `anew`, the estimates of a young session do not count any more."""
        if anew and self._kept.count <= YOUNG:
            self._steady = 1

    def _averaged(self, estimate: LightEstimate) -> LightEstimate:
        """P3 (thesis 5.4): the mean of the last estimates, as long as the light is steady."""
        rate = max(1.0 / self._steady, AVERAGE)
        return replace(estimate, sh=self._estimate.sh + rate * (estimate.sh - self._estimate.sh))

    def fold(self, slot: int, pools: Pools, shot: Shot) -> LightEstimate:
        """The light with `pools`, whose transfer lies in `slot` of the window, not averaged."""
        newest = Frame(pools, self._columns(slot, pools))
        self._kept.add(slot, newest, shot)
        with self._engine.profile.host():
            self._steady = min(self._steady + 1, self._forget(slot, newest))
        rounds = FIRST_ROUNDS if self._steady == 1 else ROUNDS if self._steady < YOUNG else STEADY_ROUNDS
        return self._refresh(slot, rounds)

    def _look_around(self, continuation: Continuation, camera: CameraModel, pose: Floats, depth_m: Columns) -> None:
        """Find planes in what is seen, and what of them cannot be."""
        used = [frame.pools.weights > 0 for frame in self._kept.frames.values()]
        positions = [frame.pools.positions[own] for frame, own in zip(self._kept.frames.values(), used, strict=True)]
        normals = [frame.pools.normals[own] for frame, own in zip(self._kept.frames.values(), used, strict=True)]
        with self._engine.profile.host():
            continuation.find(np.concatenate(positions), np.concatenate(normals))
            continuation.look(camera, pose, depth_m)

    def _judged(self) -> Judged:
        """Some pools of the window, as the albedos found last have them."""
        assert self._window is not None
        assert self._last is not None
        rows, albedos, weights = self._last
        some = np.arange(0, len(rows.seen), max(1, -(-len(rows.seen) // MOST_ROWS)))
        slots, places = rows.slots[some], rows.places[some]
        mean_albedo = self._solution.mean_albedo if self._solution else ASSUMED_ALBEDO
        _, target, scaled = system_of(rows, albedos, weights)
        positions, sent, beyond = np.empty((len(some), 3)), np.empty(len(some)), np.empty(len(some))
        for slot, frame in self._kept.frames.items():
            own, pools = slots == slot, frame.pools
            positions[own] = pools.positions[places[own]]
            sent[own] = pools.sent[places[own]] @ LUMINANCE
            beyond[own] = pools.beyond @ LUMINANCE
        return Judged(
            positions=positions,
            transfer=self._window.raw_of(slots, places).astype(np.float64),
            lobes=self._judged_lobes(),
            target=target[some] - mean_albedo * sent,
            beyond=mean_albedo * beyond,
            weights=scaled[some],
        )

    def _judged_lobes(self) -> Floats:
        if self._known is not None:
            return self._family
        return lobe_family(min(JUDGED_WIDTH_DEG, self.light.width_deg if self.light else JUDGED_WIDTH_DEG))

    def _columns(self, slot: int, pools: Pools) -> Columns:
        """[n, lobes + 1] shading of each pool, if white, under the widest family and a sky of radiance 1 all over."""
        assert self._window is not None
        return self._window.shading(slot, np.column_stack([self._family, np.ones(CELLS)]))[: pools.grid.count]

    def _refresh(self, slot: int, rounds: int) -> LightEstimate:
        """Light and albedos from the window, whose newest frame lies in `slot`."""
        rows = rows_of(self._kept.frames, self._model.normals)
        with self._engine.profile.host():
            albedos, weights = self._in_turn(rows, rounds)
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
            self._kept.frames[slot].pools.grid,
            self._bands,
            self._lit,
            albedo_known=not self._model.albedos,
        )
        return estimate

    def _window_for(self, grid: PoolGrid) -> PoolWindow:
        """The window, empty where pictures are cut into more parts than any before."""
        if self._window is None or self._window.capacity < grid.count:
            self._window = PoolWindow(self._engine, grid.count, SLOTS)
            self._kept = FrameWindow(self._kept.count)
        return self._window

    def _forget(self, slot: int, newest: Frame) -> int:
        """Weigh earlier frames by what the newest one says of them; how many frames the mean may go back."""
        if self._solution is None or not self._model.memory:
            self._kept.forget(slot, 0.0)
            return 1
        told = self._kept.weigh(slot)
        if told.frames_ago:
            return 1 + told.frames_ago // SOON
        if not told.is_told and self._contradicts(newest, self._solution):
            self._kept.forget(slot, CHANGED_WEIGHT)
            return 1
        return self._steady + 1

    def _contradicts(self, newest: Frame, solution: Solution) -> bool:
        """Whether a frame that shares no surface with others shows another light."""
        rows = rows_of({0: newest}, self._model.normals)
        albedos, weights = self._albedos(rows, solution, materials=True), weights_of(rows, None, None, outliers=False)
        columns, target, scaled = system_of(rows, albedos, weights)
        own = misfit_of(columns, target, scaled, solve_amounts(sums_of(rows, albedos, weights))[0])
        known = np.append(solution.amounts, solution.mean_albedo)
        energy = float(scaled @ target**2)
        return misfit_of(columns, target, scaled, known) > CHANGE * (own + _LEAST_MISFIT * energy)

    def _in_turn(self, rows: Rows, rounds: int) -> tuple[Albedos, Floats]:
        """Light and albedos given each other, `rounds` times; leaves the light in `_solution`."""
        if not self._model.albedos:
            rounds = min(rounds, 2)
        solution, first = self._solution, rounds == FIRST_ROUNDS
        lit = None if solution is None else np.append(solution.amounts > 0, True)
        hold = HOLD * min((self._steady - 1) / LONG, 1.0)
        albedos, weights = one_albedo(len(rows.seen)), weights_of(rows, None, None, outliers=False)
        self._one_color = not self._model.albedos or is_of_one_color(rows)
        pull = COLOR_PULL if self._one_color else None
        for number in range(rounds):
            if solution is not None:
                albedos = self._albedos(rows, solution, materials=not first or number > COLOR_ROUNDS)
                weights = weights_of(rows, solution, albedos, outliers=self._model.outliers)
            sums = sums_of(rows, albedos, weights)
            amounts, lit = solve_amounts(sums, self._mean, hold, lit)
            solution = with_colors(sums, amounts[:-1], float(amounts[-1]), pull)
        self._solution = solution
        assert solution is not None
        shape = solution.amounts / max(float(solution.amounts.sum()), 1e-300)
        self._mean = shape if self._mean is None else self._mean + (shape - self._mean) / self._steady
        return albedos, weights

    def _albedos(self, rows: Rows, solution: Solution, *, materials: bool) -> Albedos:
        if not self._model.albedos:
            return one_albedo(len(rows.seen))
        materials = materials and (self.continuation is None or not self.continuation.is_searching)
        shading = rows.shading(solution)
        return self._surfaces.albedos(rows.seen, shading, rows.weights, materials=materials, one_color=self._one_color)
