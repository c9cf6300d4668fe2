"""Regularised light estimation (thesis 5.1.3, eq. 5.5-5.6). Kernel: light_estimation.cl.

The normal equations are summed on the device, a partial sum a tile of the picture, and solved in float64 with a prior
that grows with the band, its weight chosen from the data. Samples of one tile share their errors (texture, geometry),
so the scatter of the tiles' scores, not the number of pixels, says how much a picture knows. Luminance is solved first.
A colour channel is a multiple of it plus a deviation, which a room's surfaces have more of than its light: so its prior
is tighter, and without evidence for coloured light from somewhere, shadows are neutral.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import pyopencl as cl
import pyopencl.array as cl_array
import pyopencl.cltypes as cl_types
from numpy.typing import NDArray

from protocol.frames import CameraModel
from server.maths.bayes import NormalEquations, Posterior, solve_plain, solve_with_evidence, solve_with_ratio
from server.maths.dominant import DominantLight, dominant_lights
from server.maths.memory import remembered
from server.maths.nonnegative import nonnegative_mean, nonnegative_sum
from server.maths.sh import LUMINANCE, band_of
from server.opencl.engine import Engine
from server.transfer.radiance_transfer import Transfer
from server.volume.raycast import Surface

ASSUMED_ALBEDO = 0.5
"""Reflectance that every real surface is taken to have: a common mean of rooms. It scales the light, not its shape."""
LEAST_OPENNESS = 0.05
"""Samples that see less of the sky say more about indirect light than about the sky (thesis 5.2)."""
LEAST_FLATNESS = 0.95
"""Samples nearer to an edge have a normal and a colour that may belong to two surfaces."""
LEAST_FLAT_SHARE = 0.1
"""Least share of the samples that is used, the flattest ones: in depth of one picture, not fused, no sample is flat."""
FORGETTING = 0.9
"""Factor by which earlier evidence counts less with each frame while the light is steady: a memory of ten frames (5.4).
It applies to what the new frames see."""
CHANGED_FORGETTING = 0.3
"""The same factor if a frame contradicts the light so far: a new light has 97 % of the weight after 3 frames."""
CHANGE = 3.0
"""The light has changed if the frame's misfit under it is this many times what the frame's own best fit leaves."""
_LEAST_MISFIT = 1e-4  # of the frame's energy: below it a ratio of misfits says nothing
MODEL_DOUBT = 1.3
"""Ratio of the stated standard deviation to the one that follows from the residuals. It is chosen on scenes of known
light, so that 95 % intervals contain the true light in 95 % of cases (tests/bench/light/honesty.py)."""
THESIS_FORGETTING = 0.9
COLOR_DEVIATION = 0.2
"""Prior size of a channel's deviation from its multiple of the luminance, relative to the luminance's."""
_TILE = 8
_LEAST_POOLS = 8
_DEPENDENCE_STEPS = 2  # the light and its samples' dependence are found in turn
_QUANTILE_95 = 2.4477  # radius that holds 95 % of a two-dimensional normal distribution
_VALID_RAD = np.deg2rad(15.0)


@dataclass(frozen=True)
class LightEstimate:
    """The light estimated from the images so far."""

    sh: NDArray[np.float64]
    """[bands^2, 3] radiance, RGB, world axes."""
    std: NDArray[np.float64] | None
    """[bands^2, 3] one standard deviation; None where no light has been seen."""
    condition: float
    """Condition number of the unregularised normal equations; infinite if singular."""
    valid: bool
    """Whether the pictures fix the dominant direction to 15 degrees (95 %)."""
    spread_deg: float | None = None
    """Angle that 90 % of the possible dominant directions are within; None where unknown."""

    @cached_property
    def dominant_lights(self) -> tuple[DominantLight, ...]:
        """Of `sh`, strongest first (maths/dominant.py)."""
        return dominant_lights(self.sh)

    @cached_property
    def whitened(self) -> LightEstimate:
        """The same luminance without colours, as the thesis assumes light to be (7.1)."""
        white = np.ones(3)
        std = None if self.std is None else np.outer(self.std @ LUMINANCE, white)  # as of channels that err alike
        return replace(self, sh=np.outer(self.sh @ LUMINANCE, white), std=std)


@dataclass(frozen=True)
class Evidence:
    """State of an estimator, for saving and resuming."""

    equations: NormalEquations | None
    weight: float
    dependence: float


@dataclass(frozen=True)
class TileSums:
    """Normal equations of every tile of one frame, float64."""

    matrices: NDArray[np.float64]
    """[tiles, n, n]."""
    vectors: NDArray[np.float64]
    """[tiles, n, 4] for luminance, red, green and blue."""
    energies: NDArray[np.float64]
    """[tiles, 4] likewise."""
    counts: NDArray[np.float64]
    """[tiles] samples."""

    def total(self) -> NormalEquations:
        """The frame's normal equations."""
        return NormalEquations(
            self.matrices.sum(0), self.vectors.sum(0), self.energies.sum(0), float(self.counts.sum())
        )


def sum_tiles(
    engine: Engine,
    camera: CameraModel,
    radiance: cl_array.Array,
    surface: Surface,
    transfer: Transfer,
    voxel_m: float,
    least_openness: float = LEAST_OPENNESS,
) -> TileSums:
    """Normal equations of the frame's samples: static surface, open enough, neither clipped nor black.

    radiance: [h, w] float4 as in Measurement.
    """
    observed = gather_samples(engine, camera, radiance, surface, transfer, least_openness)
    pooled_transfer, pooled = _pool(engine, camera, surface, transfer, observed, voxel_m)
    return unpack_tiles(_accumulate(engine, pooled_transfer, pooled), transfer.bands**2)


def _kernel(engine: Engine, name: str, coefficients: int) -> cl.Kernel:
    return engine.kernel("light_estimation.cl", name, COEFFICIENTS=coefficients)


def gather_samples(
    engine: Engine,
    camera: CameraModel,
    radiance: cl_array.Array,
    surface: Surface,
    transfer: Transfer,
    least_openness: float = LEAST_OPENNESS,
) -> cl_array.Array:
    """[rows, cols] float4: what the camera saw at each sample, w = 1 where usable; `radiance` as in Measurement."""
    observed = engine.workspace.array("observed", (transfer.rows, transfer.cols), cl_types.float4)
    engine.launch(
        _kernel(engine, "gather_samples", transfer.bands**2),
        (transfer.cols, transfer.rows),
        transfer.cols,
        transfer.rows,
        transfer.stride,
        camera.width,
        camera.height,
        radiance,
        surface.labels,
        transfer.openness,
        transfer.flatness,
        least_openness,
        flatness_gate(engine.download(transfer.flatness)),
        observed,
    )
    return observed


def flatness_gate(flatness: NDArray[np.float32]) -> float:
    """The least flatness of samples to use; flatness [rows, cols], 0 where there is no surface."""
    valid = flatness[flatness > 0]
    if not len(valid):
        return LEAST_FLATNESS
    return min(LEAST_FLATNESS, float(np.quantile(valid, 1 - LEAST_FLAT_SHARE)))


def _pool(
    engine: Engine,
    camera: CameraModel,
    surface: Surface,
    transfer: Transfer,
    observed: cl_array.Array,
    voxel_m: float,
) -> tuple[cl_array.Array, cl_array.Array]:
    """Means over neighbours on one surface: transfer [rows, cols, n] and observation [rows, cols] float4."""
    rows, cols, n = -(-transfer.rows // 2), -(-transfer.cols // 2), transfer.bands**2
    pooled_transfer = engine.workspace.array("pooled_transfer", (rows, cols, n), np.float32)
    pooled = engine.workspace.array("pooled", (rows, cols), cl_types.float4)
    engine.launch(
        _kernel(engine, "pool_samples", n),
        (cols, rows),
        cols,
        rows,
        transfer.cols,
        transfer.rows,
        transfer.stride,
        camera.width,
        surface.positions,
        surface.normals,
        transfer.coefficients,
        observed,
        voxel_m,
        pooled_transfer,
        pooled,
    )
    return pooled_transfer, pooled


def _accumulate(engine: Engine, transfer: cl_array.Array, observed: cl_array.Array) -> NDArray[np.float64]:
    """[tiles, entries + 2] packed sums of transfer [rows, cols, n] and observed [rows, cols], see accumulate_tiles."""
    rows, cols, n = transfer.shape
    tile_cols, tile_rows = -(-cols // _TILE), -(-rows // _TILE)
    entries = (n + 3) * (n + 4) // 2
    partial = engine.workspace.array("tile_sums", (tile_cols * tile_rows, entries + 2), np.float32)
    engine.launch(
        _kernel(engine, "accumulate_tiles", n),
        (tile_cols * tile_rows * _TILE * _TILE,),
        cols,
        rows,
        tile_cols,
        transfer,
        observed,
        partial,
        local=(_TILE * _TILE,),
    )
    return engine.download(partial).astype(np.float64)


def unpack_tiles(partial: NDArray[np.float64], n: int) -> TileSums:
    """Split [tiles, entries + 2] packed upper triangles of the sums of (transfer, r, g, b) into their parts."""
    used = partial[partial[:, -1] > 0]
    full = np.zeros((len(used), n + 3, n + 3))
    upper = np.triu_indices(n + 3)
    full[:, upper[0], upper[1]] = used[:, :-2]
    full[:, upper[1], upper[0]] = used[:, :-2]
    mix = np.vstack([LUMINANCE, np.eye(3)])
    energies = np.einsum("ca,tab,cb->tc", mix, full[:, n:, n:], mix)
    return TileSums(full[:, :n, :n], full[:, :n, n:] @ mix.T, energies, used[:, -1])


class LightEstimator:
    """The running estimate of one session's light."""

    def __init__(self, bands: int, *, as_thesis: bool = False, memory: bool = True) -> None:
        """`as_thesis`: white light by plain least squares, a memory as long as a moving average of 10 (5.4).

        `memory`: earlier frames count (P3).
        """
        self._memory = memory
        self._bands = bands
        self._as_thesis = as_thesis
        self._precision = prior_precision(bands)
        self._evidence: NormalEquations | None = None
        self._weight = 0.0
        self._dependence = 1.0

    def update(self, tiles: TileSums) -> LightEstimate:
        """Fold one frame's sums in and solve. A frame that saw nothing leaves the estimate as it was."""
        frame = tiles.total()
        if frame.count >= _LEAST_POOLS:
            forgetting = self._forgetting_for(frame)
            self._evidence = self._beside(frame, forgetting) + frame
            self._weight = forgetting * self._weight + 1.0
            for _ in range(_DEPENDENCE_STEPS):
                luminance = self._solve_luminance(self._evidence)
                ridge = self._dependence * luminance.ratio * np.diag(self._precision)
                self._dependence = sample_dependence(tiles, luminance.mean[:, 0], ridge)
        return self.estimate()

    def evidence(self) -> Evidence:
        """Everything that the estimate depends on."""
        return Evidence(self._evidence, self._weight, self._dependence)

    def resume(self, known: Evidence) -> None:
        """Continue from the `evidence` of an estimator with as many bands."""
        self._evidence, self._weight, self._dependence = known.equations, known.weight, known.dependence

    def estimate(self) -> LightEstimate:
        """The light as it stands."""
        n = self._bands**2
        if self._evidence is None:
            return LightEstimate(np.zeros((n, 3)), None, float("inf"), valid=False)
        luminance = self._solve_luminance(self._evidence)
        fixed = direction_spread_rad(luminance) <= _VALID_RAD
        if self._as_thesis:
            mean, std = np.tile(luminance.mean, 3), np.tile(luminance.std(0)[:, None], 3)
        else:
            mean, std = self._solve_color(self._evidence, luminance)
        std = MODEL_DOUBT * std / ASSUMED_ALBEDO
        return LightEstimate(mean / ASSUMED_ALBEDO, std, luminance.condition, valid=bool(fixed))

    def _beside(self, frame: NormalEquations, forgetting: float) -> NormalEquations:
        """Earlier evidence that is kept; while the light is steady, all on which `frame` has no bearing."""
        if self._evidence is None:
            return frame.scaled(0.0)
        if forgetting != FORGETTING or self._as_thesis:
            return self._evidence.scaled(forgetting)
        return remembered(self._evidence, frame, forgetting)

    def _forgetting_for(self, frame: NormalEquations) -> float:
        """How much of the evidence so far to keep beside `frame`."""
        if self._evidence is None or not self._memory:
            return 0.0
        if self._as_thesis:
            return THESIS_FORGETTING
        luminance = frame.channels(0, 1)
        misfit = float(luminance.less(self._solve_luminance(self._evidence).mean).energy[0])
        own = solve_with_evidence(luminance.scaled(1 / self._dependence), self._precision).mean
        least = float(luminance.less(own).energy[0]) + _LEAST_MISFIT * float(luminance.energy[0])
        return CHANGED_FORGETTING if misfit > CHANGE * least else FORGETTING

    def _thinned(self, evidence: NormalEquations) -> NormalEquations:
        """Evidence of one average frame, thinned to its number of independent samples."""
        return evidence.scaled(1 / (self._weight * self._dependence))

    def _solve_luminance(self, evidence: NormalEquations) -> Posterior:
        solve = solve_plain if self._as_thesis else solve_with_evidence
        return solve(self._thinned(evidence).channels(0, 1), self._precision)

    def _solve_color(
        self, evidence: NormalEquations, luminance: Posterior
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Coefficients [n, 3] of the non-negative light and their standard deviation, both times the albedo."""
        shape = nonnegative_mean(luminance.mean[:, 0], np.asarray(np.linalg.inv(luminance.shape)))
        equations = self._thinned(evidence).channels(1, 4)
        tint = (shape @ equations.vector) / max(float(shape @ equations.matrix @ shape), 1e-300)
        rest = equations.less(np.outer(shape, tint))
        ratio = luminance.ratio * rest.energy.mean() / (rest.count * luminance.noise[0])
        deviation = solve_with_ratio(rest, self._precision / COLOR_DEVIATION**2, float(ratio))
        mean = nonnegative_sum(np.outer(shape, tint), deviation.mean)
        std = np.stack([np.hypot(tint[c] * luminance.std(0), deviation.std(c)) for c in range(3)], axis=1)
        return mean, std


def prior_precision(bands: int) -> NDArray[np.float64]:
    """[bands^2] relative prior precision of the coefficients: rooms' light falls off with the band."""
    band = band_of(bands * bands)
    return 1.0 + band * (band + 1.0)


def sample_dependence(tiles: TileSums, light: NDArray[np.float64], ridge: NDArray[np.float64]) -> float:
    """How many samples count as one for the luminance `light` [n]: scatter of the tiles' scores over that of
    independent samples, at least 1.

    The score of a tile is its part of the gradient, A_t^T (y_t - A_t x); for independent noise of variance s^2 its
    covariance is s^2 A_t^T A_t. Compared in the metric of the normal matrix plus `ridge`, which ignores the unseen.
    """
    total = tiles.total()
    metric = np.linalg.inv(total.matrix + ridge)
    expected = float(np.sum(total.matrix * metric))
    scores = tiles.vectors[:, :, 0] - tiles.matrices @ light
    scatter = float(np.einsum("ti,ij,tj->", scores, metric, scores))
    residual = float(total.energy[0] + light @ (total.matrix @ light - 2 * total.vector[:, 0]))
    noise = max(residual, 1e-12 * float(total.energy[0]) + 1e-30) / total.count
    return max(1.0, scatter / (noise * expected))


def direction_spread_rad(luminance: Posterior) -> float:
    """Half-angle in radians of the cone that holds the dominant direction with 95 %; pi where there is none."""
    linear = [3, 1, 2]  # x, y, z
    vector = luminance.mean[linear, 0]
    length = float(np.linalg.norm(vector))
    if length < 1e-12:
        return float(np.pi)
    across = np.eye(3) - np.outer(vector, vector) / length**2
    covariance = across @ luminance.covariance(0)[np.ix_(linear, linear)] @ across
    spread = float(np.sqrt(max(np.linalg.eigvalsh(covariance)[-1], 0.0)))
    return float(np.arctan2(_QUANTILE_95 * spread, length))
