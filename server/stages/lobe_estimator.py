"""Light estimation (thesis 5.1.3) as it is in a room: non-negative, from everywhere, off surfaces of unknown albedo.

Model: radiance = albedo (visible sky + what surfaces send). The pools of the last frames are kept; their albedos and
the light are found in turn, each given the other, a few rounds a frame. Luminance comes first. A colour channel is
drawn to a multiple of it, as surfaces have more colour than light: without evidence for coloured light, shadows are
neutral. How fast earlier frames are forgotten is what would have predicted the newest one best.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import pyopencl.array as cl_array
from numpy.typing import NDArray

from protocol.frames import CameraModel
from server.maths.lobes import (
    CELLS,
    RIDGE,
    WIDTHS_DEG,
    CellEquations,
    LobeFit,
    cells_to_sh,
    fit_lobes,
    fit_width,
    lobe_family,
    spread_of,
)
from server.maths.nonnegative_qp import solve_nonnegative
from server.maths.normals import NormalWeights, normal_weights
from server.maths.sh import LUMINANCE
from server.maths.surfaces import Albedos, Surfaces, one_albedo
from server.opencl.engine import Engine
from server.stages.cell_transfer import PoolGrid, Pools, PoolWindow, pool_grid
from server.stages.continuation import MOST_ROWS, NO_PLANES, Continuation, Judged
from server.stages.indirect import mean_sent
from server.stages.light_estimation import ASSUMED_ALBEDO, LightEstimate
from server.stages.radiance_transfer import Directions, Transfer
from server.stages.raycast import Surface

Floats = NDArray[np.float64]
Columns = NDArray[np.float32]

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
COLOR_PULL = 25.0
"""How much more a channel is drawn to its multiple of the luminance than to darkness: deviations of a fifth."""
ALBEDO_SPREAD = 0.15
"""Deviation of a room's mean albedo from ASSUMED_ALBEDO, as far as indirect light does not tell."""
ALBEDO_RANGE = (0.15, 0.9)
"""A room's mean albedo."""
UNSEEN_SPREAD = 0.5
"""Relative deviation of what surface sends that no picture shows."""
NOISE = 0.1
"""Relative deviation of a pool's radiance from its model, at least in order of magnitude."""
ALIKE = 200.0
"""Pools that say of the mean albedo what one says: neighbours err alike."""
BRIGHTER_COUNTS = 0.6
"""Weight of a pool goes with its expected radiance to minus this power: 0 for even, 2 for relative noise."""
LEAST_WEIGHT = 8.0
"""Pools without which a frame says nothing."""
ROUNDS, FIRST_ROUNDS, COLOR_ROUNDS = 4, 16, 4
"""Of light and albedos in turn: in a frame, in the first and after a change, and how many of those by colour alone."""
JUDGED_WIDTH_DEG = 25.0
"""Of the lobes that extents are judged with: a light of wide lobes alone would have planes make its edges."""
ONE_COLOR = 0.12
"""Root mean square scatter of reflected colours, as logarithms of ratios, that counts as one colour."""
MODEL_DOUBT = 1.6
"""Of the standard deviation over what the residuals tell of it, as in light_estimation.py; albedos err too."""
_DARK = 1e-4
_PATCH = 8  # pools along the side of a patch, within which their errors are alike
_SCORE_MEMORY = 0.8  # so a lasting excess of a tenth adds up to a half
_LEAST_MISFIT = 1e-4  # of the frame's energy: below it a ratio of misfits says nothing
_VALID_RAD = np.deg2rad(15.0)
_QUANTILE_95 = 2.4477  # radius that holds 95 % of a two-dimensional normal distribution
_LINEAR = [3, 1, 2]  # x, y, z


@dataclass(frozen=True)
class LightModel:
    """What the estimator knows of and leaves out, each a switch."""

    albedos: bool = True
    """B2: surfaces have albedos of their own."""
    normals: NormalWeights = "none"
    """P3: weights by the distribution of normals."""
    memory: bool = True
    """P3: earlier frames count."""
    outliers: bool = True
    """Pools that fit badly count less."""


@dataclass
class _Frame:
    """One frame of the window."""

    pools: Pools
    columns: Columns
    """[n, lobes + 1] shading under each lobe of the widest family, and the share of the sky that is open."""
    keep: float = 1.0

    @property
    def continued(self) -> Floats:
        """[n] share of the sky that continued planes hide."""
        return np.maximum(self.pools.open - self.columns[:, -1], 0.0)


@dataclass(frozen=True)
class _Rows:
    """All pools in use, frame by frame."""

    slots: NDArray[np.int64]
    places: NDArray[np.int64]
    columns: Columns
    seen: Floats
    sent: Floats
    unseen: Floats
    share: Floats
    weights: Floats

    @property
    def luminance(self) -> Floats:
        return np.asarray(self.seen @ LUMINANCE)

    @property
    def sent_luminance(self) -> Floats:
        return np.asarray(self.sent @ LUMINANCE)


@dataclass(frozen=True)
class _Solution:
    """Light as amounts of the widest family, for relative albedos, and the mean albedo."""

    amounts: Floats
    """[lobes] of luminance."""
    colors: Floats
    """[lobes, 3]."""
    mean_albedo: float


class LobeEstimator:
    """The running estimate of one session's light."""

    def __init__(
        self, engine: Engine, bands: int, model: LightModel | None = None, continuation: Continuation | None = None
    ) -> None:
        self._engine = engine
        self._model = model or LightModel()
        self.continuation = continuation
        self._to_sh = cells_to_sh(bands)
        self._window: PoolWindow | None = None
        self._frames: dict[int, _Frame] = {}
        self._next = 0
        self._surfaces = Surfaces()
        self._solution: _Solution | None = None
        self._one_color = True
        self._memory = 0
        self._steady, self._is_fresh = 0, True
        self._scores = np.zeros(len(MEMORIES))
        self._predictions: list[Floats] = []
        self._last: tuple[_Rows, Albedos, Floats] | None = None
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
        hits: cl_array.Array,
        voxel_m: float,
        volume_from_camera: Floats,
        depth_m: cl_array.Array,
    ) -> LightEstimate:
        """Fold one frame in and solve. A frame that saw nothing leaves the estimate as it was.

        observed: [rows, cols] float4 of the samples, w = 1 usable; hits: see indirect.py; depth_m: [h, w] as measured.
        """
        window = self._window_for(pool_grid(transfer))
        slot = self._next
        self._frames.pop(slot, None)
        pools = window.pool(
            slot, surface, camera, transfer, rays, observed, hits, mean_sent(self._engine, hits), voxel_m
        )
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
                    frame.columns = window.shading(held, _lobes_and_all())
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
        columns = self._window.shading(slot, _lobes_and_all())
        newest = _Frame(pools, columns)
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
        _, target, scaled = self._system(rows, albedos, weights)
        pools = [
            (self._frames[slot].pools, place) for slot, place in zip(rows.slots[some], rows.places[some], strict=True)
        ]
        sent = np.array([frame.sent[place] @ LUMINANCE for frame, place in pools])
        return Judged(
            positions=np.array([frame.positions[place] for frame, place in pools]),
            transfer=raw,
            lobes=lobe_family(min(JUDGED_WIDTH_DEG, self.light.width_deg if self.light else JUDGED_WIDTH_DEG)),
            target=target[some] - mean_albedo * sent,
            beyond=mean_albedo * np.array([frame.beyond @ LUMINANCE for frame, _ in pools]),
            weights=scaled[some],
        )

    def _refresh(self, slot: int, rounds: int) -> LightEstimate:
        """Light and albedos from the window, whose newest frame lies in `slot`."""
        rows = self._rows(self._frames)
        with self._engine.profile.host():
            albedos, weights = self._in_turn(rows, rounds)
            self._predictions = self._predict(albedos, weights, rows)
        self.materials = albedos.count
        self._last = (rows, albedos, weights)
        return self._solve(rows, albedos, weights, slot)

    def _window_for(self, grid: PoolGrid) -> PoolWindow:
        """The window, empty where pictures are cut otherwise than before."""
        if self._window is None or self._window.grid != grid:
            self._window = PoolWindow(self._engine, grid, SLOTS)
            self._frames, self._next, self._predictions = {}, 0, []
        return self._window

    def _forget(self, newest: _Frame) -> int:
        """Weigh earlier frames by what the newest one says of them; how many rounds to take."""
        if self._solution is None or not self._frames:
            return FIRST_ROUNDS
        rows = self._rows({0: newest})
        albedos, weights = self._albedos(rows, self._solution, materials=True), self._weights(rows, None, None)
        columns, target, scaled = self._system(rows, albedos, weights)
        energy = float(scaled @ target**2)
        own = _misfit(columns, target, scaled, self._solve_amounts(columns, target, scaled)) + _LEAST_MISFIT * energy
        misfits = np.array([_misfit(columns, target, scaled, x) for x in self._predictions])
        if len(misfits):
            self._scores = _SCORE_MEMORY * self._scores + np.log(misfits + _LEAST_MISFIT * energy)
        known = np.append(self._solution.amounts, self._solution.mean_albedo)
        changed = _misfit(columns, target, scaled, known) > CHANGE * own
        self._memory = int(np.flatnonzero(self._scores <= self._scores.min() + np.log(WORTH_FORGETTING))[0])
        memory = MEMORIES[self._memory]
        for frame in self._frames.values():
            frame.keep *= (CHANGED_WEIGHT if changed else memory) if self._model.memory else 0.0
        if changed:
            self._scores = np.zeros(len(MEMORIES))
        return FIRST_ROUNDS if changed else ROUNDS

    def _rows(self, frames: dict[int, _Frame]) -> _Rows:
        """Pools of `frames` that count."""
        parts = []
        for slot, frame in sorted(frames.items()):
            pools = frame.pools
            places = np.flatnonzero((pools.weights > 0) & (frame.keep > 1e-3))
            factor = normal_weights(pools.normals[places], pools.weights[places], self._model.normals)
            share, beyond = pools.weights[places], frame.continued[places]
            parts.append(
                (np.full(len(places), slot), places, frame.columns[places, :-1], pools.seen[places],
                 pools.sent[places] + beyond[:, None] * pools.beyond, pools.unseen[places] + beyond, share,
                 frame.keep * factor * share)
            )  # fmt: skip
        return _Rows(*(np.concatenate(column) for column in zip(*parts, strict=True)))

    def _in_turn(self, rows: _Rows, rounds: int) -> tuple[Albedos, Floats]:
        """Light and albedos given each other, `rounds` times; leaves the light in `_solution`."""
        if not self._model.albedos:
            rounds = min(rounds, 2)
        solution, first = self._solution, rounds == FIRST_ROUNDS
        albedos, weights = one_albedo(len(rows.seen)), self._weights(rows, None, None)
        self._one_color = not self._model.albedos or self._is_of_one_color(rows)
        pull = COLOR_PULL if self._one_color else None
        for number in range(rounds):
            if solution is not None:
                albedos = self._albedos(rows, solution, materials=not first or number > COLOR_ROUNDS)
                weights = self._weights(rows, solution, albedos)
            columns, target, scaled = self._system(rows, albedos, weights)
            amounts = self._solve_amounts(columns, target, scaled)
            solution = self._with_colors(rows, albedos, weights, amounts[:-1], float(amounts[-1]), pull)
        self._solution = solution
        return albedos, weights

    def _is_of_one_color(self, rows: _Rows) -> bool:
        """Whether coloured light on surfaces of one colour explains all colours.

        If it does, there is no telling it from surfaces of many colours, and colourless rooms under coloured lights are
        the simpler world.
        """
        albedos, weights = one_albedo(len(rows.seen)), self._weights(rows, None, None)
        amounts = self._solve_amounts(*self._system(rows, albedos, weights))
        mean_albedo = float(amounts[-1])
        colors = self._with_colors(rows, albedos, weights, amounts[:-1], mean_albedo, pull=0.0).colors
        shading = rows.columns @ colors + mean_albedo * rows.sent
        reflected = np.log(np.maximum(rows.seen, _DARK) / np.maximum(shading, _DARK))
        ratios = reflected[:, [0, 2]] - reflected[:, 1:2]
        apart = np.linalg.norm(ratios - np.median(ratios, axis=0), axis=1)
        return bool(np.sqrt(np.mean(np.minimum(apart, 3 * np.median(apart)) ** 2)) < ONE_COLOR)

    def _albedos(self, rows: _Rows, solution: _Solution, *, materials: bool) -> Albedos:
        if not self._model.albedos:
            return one_albedo(len(rows.seen))
        materials = materials and (self.continuation is None or not self.continuation.is_searching)
        shading = rows.columns @ solution.colors + solution.mean_albedo * rows.sent
        return self._surfaces.albedos(rows.seen, shading, rows.weights, materials=materials, one_color=self._one_color)

    def _weights(self, rows: _Rows, solution: _Solution | None, albedos: Albedos | None) -> Floats:
        """[n] of residuals in radiance."""
        luminance = rows.luminance
        mean = max(float(luminance.mean()), 1e-12)
        doubt = UNSEEN_SPREAD * ASSUMED_ALBEDO * rows.unseen * rows.sent_luminance.mean()
        weights = rows.weights / (1.0 + (doubt / (NOISE * np.maximum(luminance, 0.05 * mean))) ** 2)
        if solution is None or albedos is None:
            return np.asarray(weights)
        explained = rows.columns @ solution.amounts + solution.mean_albedo * rows.sent_luminance
        expected = np.maximum(albedos.lightness * explained, 0.05 * mean)
        weights = weights * (mean / expected) ** BRIGHTER_COUNTS
        if self._model.outliers:
            apart = np.abs(luminance / expected - 1.0)
            usual = 1.4826 * float(np.median(apart)) + 0.01
            weights = weights / (1.0 + (apart / (2.0 * usual)) ** 2)
        return np.asarray(weights)

    def _system(self, rows: _Rows, albedos: Albedos, weights: Floats) -> tuple[Floats, Floats, Floats]:
        """Columns [n, lobes + 1] (the last: what surfaces send, times the mean albedo), target [n] and its weights."""
        columns = np.column_stack([rows.columns, rows.sent_luminance])
        return columns, rows.luminance / albedos.lightness, weights * albedos.lightness**2

    def _solve_amounts(self, columns: Floats, target: Floats, weights: Floats) -> Floats:
        """[lobes + 1] >= 0: amounts, and the mean albedo, drawn to ASSUMED_ALBEDO."""
        weighted = weights[:, None] * columns
        matrix, vector = weighted.T @ columns, weighted.T @ target
        lobes = len(matrix) - 1
        pull = np.full(lobes + 1, RIDGE * max(float(np.trace(matrix[:lobes, :lobes])) / lobes, 1e-300))
        independent = max(len(target) / ALIKE, 1.0)
        noise = max(float(weights @ target**2) * NOISE**2 / independent, 1e-300)
        pull[-1] = noise / ALBEDO_SPREAD**2
        vector[-1] += pull[-1] * ASSUMED_ALBEDO
        amounts, _ = solve_nonnegative(matrix + np.diag(pull), vector)
        amounts[-1] = np.clip(amounts[-1], *ALBEDO_RANGE)
        return amounts

    def _with_colors(
        self,
        rows: _Rows,
        albedos: Albedos,
        weights: Floats,
        amounts: Floats,
        mean_albedo: float,
        pull: float | None,
    ) -> _Solution:
        """The solution with its colours, each channel drawn to a multiple of the luminance by `pull` times the ridge.

        None: each is one, as while surfaces of many colours are looked for, which else would pass for coloured light.
        """
        scaled = weights * albedos.lightness**2
        weighted = scaled[:, None] * rows.columns
        target = rows.seen / (albedos.lightness[:, None] * albedos.color) - mean_albedo * rows.sent
        vectors = weighted.T @ target
        if pull is None:
            along = max(float(scaled @ (rows.columns @ amounts) ** 2), 1e-300)
            return _Solution(amounts, amounts[:, None] * np.maximum(amounts @ vectors / along, 0.0), mean_albedo)
        matrix = weighted.T @ rows.columns
        tint = np.maximum(amounts @ vectors / max(float(amounts @ matrix @ amounts), 1e-300), 0.0)
        ridge = RIDGE * max(float(np.trace(matrix)) / len(matrix), 1e-300)
        regular, near = matrix + ridge * (1.0 + pull) * np.eye(len(matrix)), ridge * pull * amounts
        colors = [solve_nonnegative(regular, vectors[:, c] + tint[c] * near)[0] for c in range(3)]
        return _Solution(amounts, np.stack(colors, axis=1), mean_albedo)

    def _predict(self, albedos: Albedos, weights: Floats, rows: _Rows) -> list[Floats]:
        """For each memory, the light that all frames so far make under it."""
        columns, target, scaled = self._system(rows, albedos, weights)
        order = sorted(self._frames, key=lambda s: (s - self._next) % SLOTS)  # oldest first
        age = {slot: len(order) - 1 - place for place, slot in enumerate(order)}
        keep = np.array([self._frames[slot].keep for slot in rows.slots])
        ages = np.array([age[slot] for slot in rows.slots])
        return [self._solve_amounts(columns, target, scaled / keep * memory**ages) for memory in MEMORIES]

    def _solve(self, rows: _Rows, albedos: Albedos, weights: Floats, slot: int) -> LightEstimate:
        """The light in cells, of the width that the pictures call for, and what is known of it."""
        assert self._window is not None
        assert self._solution is not None
        mean_albedo = self._solution.mean_albedo
        count = SLOTS * self._window.grid.count
        place = rows.slots * self._window.grid.count + rows.places
        targets, scaled = np.zeros((count, 4)), np.zeros(count)
        lightness = albedos.lightness
        targets[place, 0] = rows.luminance / lightness - mean_albedo * rows.sent_luminance
        targets[place, 1:] = rows.seen / (lightness[:, None] * albedos.color) - mean_albedo * rows.sent
        scaled[place] = weights * lightness**2
        luminance, *channels = self._window.equations(targets, scaled)
        light = self.light = fit_lobes(luminance)
        radiances, tints = self._channels(channels, light)
        is_new = rows.slots == slot
        expected = np.zeros(self._window.grid.count)
        shading = rows.columns[is_new] @ self._solution.amounts
        expected[rows.places[is_new]] = np.sqrt(scaled[place[is_new]]) * (targets[place[is_new], 0] - shading)
        alike = _dependence(expected.reshape(self._window.grid.rows, -1))
        noise = alike * luminance.misfit(light.cells) / max(float((rows.weights).sum()), 1e-300)
        root = self._to_sh @ spread_of(luminance, light, noise)
        std = MODEL_DOUBT * np.sqrt((root**2).sum(axis=1))[:, None] * tints
        if self._model.albedos:  # brightness is known as well as the albedo
            std = np.hypot(std, ALBEDO_SPREAD / ASSUMED_ALBEDO * np.abs(self._to_sh @ radiances))
        vector = (self._to_sh @ light.cells)[_LINEAR]
        scale = mean_albedo if rows.sent.any() else ASSUMED_ALBEDO
        return LightEstimate(
            self._to_sh @ radiances / scale,
            std / scale,
            _condition(luminance.matrix),
            valid=bool(_direction_spread_rad(vector, root[_LINEAR]) <= _VALID_RAD),
        )

    def _channels(self, channels: list[CellEquations], light: LobeFit) -> tuple[Floats, Floats]:
        """Radiances [CELLS, 3] of the light in colour, and the mean colour [3]."""
        radiances, tints = [], []
        for channel in channels:
            along = max(float(light.cells @ channel.matrix @ light.cells), 1e-300)
            tint = max(float(light.cells @ channel.vector) / along, 0.0)
            radiances.append(fit_width(channel, light.width_deg, near=tint * light.cells, pull=COLOR_PULL).cells)
            tints.append(tint)
        return np.stack(radiances, axis=1), np.array(tints)


def _lobes_and_all() -> Floats:
    """[CELLS, lobes + 1] the widest family, and a sky of radiance 1 all over."""
    return np.column_stack([lobe_family(WIDTHS_DEG[0]), np.ones(CELLS)])


def _misfit(columns: Floats, target: Floats, weights: Floats, amounts: Floats) -> float:
    return float(weights @ (target - columns @ amounts) ** 2)


def _dependence(residual: Floats) -> float:
    """How many pools count as one: sums of residuals [rows, cols] over patches scatter so much more than independent
    ones would; at least 1."""
    square = float((residual**2).sum())
    rows, cols = (np.arange(0, size, _PATCH) for size in residual.shape)
    patches = np.add.reduceat(np.add.reduceat(residual, rows, 0), cols, 1)
    return max(1.0, float((patches**2).sum()) / square) if square > 0 else 1.0


def _condition(matrix: Floats) -> float:
    """Of what the normal equations say of the cells, before any prior; infinite if singular."""
    values = np.linalg.eigvalsh(matrix)
    return float(values[-1] / values[0]) if values[0] > values[-1] * 1e-14 and values[-1] > 0 else float("inf")


def _direction_spread_rad(vector: Floats, root: Floats) -> float:
    """Half-angle of the cone that holds the direction of `vector` [3] with 95 %; root [3, k]: of its covariance."""
    length = float(np.linalg.norm(vector))
    if length < 1e-12:
        return float(np.pi)
    across = (np.eye(3) - np.outer(vector, vector) / length**2) @ root
    spread = float(np.sqrt(max(np.linalg.eigvalsh(across @ across.T)[-1], 0.0)))
    return float(np.arctan2(_QUANTILE_95 * spread, length))
