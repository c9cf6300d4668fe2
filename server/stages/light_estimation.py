"""Light estimation (thesis 5.1.3, eq. 5.5-5.6), solved so that it cannot blow up. Kernel: light_estimation.cl.

The normal equations are summed on the device, a partial sum a tile of the picture, and solved in float64 with a prior
that grows with the band, its weight chosen from the data. Samples of one tile share their errors (texture, geometry),
so the scatter of the tiles' scores, not the number of pixels, says how much a picture knows.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pyopencl.cltypes as cl_types
from numpy.typing import NDArray

from protocol.frames import CameraModel
from server.maths.bayes import NormalEquations, Posterior, solve_plain, solve_with_evidence
from server.maths.sh import LUMINANCE, band_of, dominant_direction
from server.opencl.engine import Engine
from server.stages.measure import Measurement
from server.stages.radiance_transfer import Transfer
from server.stages.raycast import Surface

ASSUMED_ALBEDO = 0.5
"""Reflectance that every real surface is taken to have: a common mean of rooms. It scales the light, not its shape."""
LEAST_OPENNESS = 0.05
"""Samples that see less of the sky say more about indirect light than about the sky (thesis 5.2)."""
FORGETTING = 0.6
"""What remains of earlier frames' evidence a frame later: a new light has 78 % of the weight after 3 frames."""
THESIS_FORGETTING = 0.9
_TILE = 8
_LEAST_SAMPLES = 32
_DEPENDENCE_STEPS = 2  # the light and its samples' dependence are found in turn
_QUANTILE_95 = 2.4477  # radius that holds 95 % of a two-dimensional normal distribution
_VALID_RAD = np.deg2rad(15.0)


@dataclass(frozen=True)
class LightEstimate:
    """The light as the pictures so far have it."""

    sh: NDArray[np.float64]
    """[bands^2, 3] radiance, RGB, world axes."""
    std: NDArray[np.float64] | None
    """[bands^2, 3] one standard deviation; None where nothing has been seen."""
    condition: float
    """Condition number of the unregularised normal equations; infinite if singular."""
    valid: bool
    """Whether the pictures fix the dominant direction to 15 degrees (95 %)."""


@dataclass(frozen=True)
class TileSums:
    """Normal equations of every tile of one frame, float64."""

    matrices: NDArray[np.float64]
    """[tiles, n, n]."""
    vectors: NDArray[np.float64]
    """[tiles, n, 3]."""
    energies: NDArray[np.float64]
    """[tiles, 3]."""
    counts: NDArray[np.float64]
    """[tiles] samples."""

    def total(self) -> NormalEquations:
        """The frame's normal equations."""
        return NormalEquations(
            self.matrices.sum(0), self.vectors.sum(0), self.energies.sum(0), float(self.counts.sum())
        )


def sum_tiles(
    engine: Engine, camera: CameraModel, measurement: Measurement, surface: Surface, transfer: Transfer
) -> TileSums:
    """Normal equations of the frame's samples: static surface, open enough, neither clipped nor black."""
    space = engine.workspace
    rows, cols, n = transfer.rows, transfer.cols, transfer.bands**2
    defines = {"COEFFICIENTS": n}
    observed = space.array("observed", (rows, cols), cl_types.float4)
    engine.launch(
        engine.kernel("light_estimation.cl", "gather_samples", **defines),
        (cols, rows),
        cols,
        rows,
        transfer.stride,
        camera.width,
        camera.height,
        measurement.radiance,
        surface.labels,
        transfer.openness,
        LEAST_OPENNESS,
        observed,
    )
    tile_cols, tile_rows = -(-cols // _TILE), -(-rows // _TILE)
    entries = (n + 3) * (n + 4) // 2
    partial = space.array("tile_sums", (tile_cols * tile_rows, entries + 2), np.float32)
    engine.launch(
        engine.kernel("light_estimation.cl", "accumulate_tiles", **defines),
        (tile_cols * tile_rows * _TILE * _TILE,),
        cols,
        rows,
        tile_cols,
        transfer.coefficients,
        observed,
        partial,
        local=(_TILE * _TILE,),
    )
    return unpack_tiles(engine.download(partial).astype(np.float64), n)


def unpack_tiles(partial: NDArray[np.float64], n: int) -> TileSums:
    """Split [tiles, entries + 2] packed upper triangles of the sums of (transfer, r, g, b) into their parts."""
    used = partial[partial[:, -1] > 0]
    full = np.zeros((len(used), n + 3, n + 3))
    upper = np.triu_indices(n + 3)
    full[:, upper[0], upper[1]] = used[:, :-2]
    full[:, upper[1], upper[0]] = used[:, :-2]
    return TileSums(full[:, :n, :n], full[:, :n, n:], np.einsum("tcc->tc", full[:, n:, n:]), used[:, -1])


class LightEstimator:
    """The running estimate of one session's light."""

    def __init__(self, bands: int, *, as_thesis: bool = False) -> None:
        """`as_thesis`: plain least squares and a memory as long as a moving average of 10 (thesis 5.4)."""
        self._bands = bands
        self._solver = solve_plain if as_thesis else solve_with_evidence
        self._forgetting = THESIS_FORGETTING if as_thesis else FORGETTING
        self._precision = prior_precision(bands)
        self._evidence: NormalEquations | None = None
        self._weight = 0.0
        self._dependence = 1.0

    def update(self, tiles: TileSums) -> LightEstimate:
        """Fold one frame's sums in and solve. A frame that saw nothing leaves the estimate as it was."""
        frame = tiles.total()
        if frame.count >= _LEAST_SAMPLES:
            kept = self._evidence.scaled(self._forgetting) if self._evidence else frame.scaled(0.0)
            self._evidence = kept + frame
            self._weight = self._forgetting * self._weight + 1.0
            for _ in range(_DEPENDENCE_STEPS):
                ridge = self._dependence * self._solve().ratio * np.diag(self._precision)
                self._dependence = sample_dependence(tiles, self._solve().mean, ridge)
        return self.estimate()

    def estimate(self) -> LightEstimate:
        """The light as it stands."""
        n = self._bands**2
        if self._evidence is None:
            return LightEstimate(np.zeros((n, 3)), None, float("inf"), valid=False)
        posterior = self._solve()
        std = np.sqrt(np.diag(posterior.shape)[:, None] * posterior.noise[None, :])
        light = posterior.mean / ASSUMED_ALBEDO
        fixed = direction_spread_rad(light, posterior) <= _VALID_RAD
        return LightEstimate(light, std / ASSUMED_ALBEDO, posterior.condition, valid=bool(fixed))

    def _solve(self) -> Posterior:
        """Posterior from the evidence of one average frame, thinned to its number of independent samples."""
        assert self._evidence is not None
        return self._solver(self._evidence.scaled(1 / (self._weight * self._dependence)), self._precision)


def prior_precision(bands: int) -> NDArray[np.float64]:
    """[bands^2] relative prior precision of the coefficients: rooms' light falls off with the band."""
    band = band_of(bands * bands)
    return 1.0 + band * (band + 1.0)


def sample_dependence(tiles: TileSums, light: NDArray[np.float64], ridge: NDArray[np.float64]) -> float:
    """How many samples count as one: scatter of the tiles' scores over what independent samples would give, >= 1.

    The score of a tile is its part of the gradient, A_t^T (y_t - A_t x); for independent noise of variance s^2 its
    covariance is s^2 A_t^T A_t. Compared in the metric of the normal matrix plus `ridge`, which ignores the unseen.
    """
    total = tiles.total()
    metric = np.linalg.inv(total.matrix + ridge)
    expected = float(np.sum(total.matrix * metric))
    scores = tiles.vectors - tiles.matrices @ light
    scatter = np.einsum("tic,ij,tjc->c", scores, metric, scores)
    residual = total.energy + np.sum(light * (total.matrix @ light - 2 * total.vector), axis=0)
    noise = np.maximum(residual, 1e-12 * total.energy + 1e-30) / total.count
    return float(max(1.0, np.mean(scatter / (noise * expected))))


def direction_spread_rad(light: NDArray[np.float64], posterior: Posterior) -> float:
    """Half-angle in radians of the cone that holds the dominant direction with 95 %; pi where there is none."""
    direction = dominant_direction(light)
    if not direction.any():
        return float(np.pi)
    linear = [3, 1, 2]  # x, y, z
    noise = float(np.sum((LUMINANCE / ASSUMED_ALBEDO) ** 2 * posterior.noise))
    covariance = posterior.shape[np.ix_(linear, linear)] * noise
    across = np.eye(3) - np.outer(direction, direction)
    spread = float(np.sqrt(max(np.linalg.eigvalsh(across @ covariance @ across)[-1], 0.0)))
    length = float(np.linalg.norm((light @ LUMINANCE)[linear]))
    return float(np.arctan2(_QUANTILE_95 * spread, length))
