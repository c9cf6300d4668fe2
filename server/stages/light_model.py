"""The model that light estimation in a room fits, and its parts, each solved given the others.

Model: radiance = albedo (visible sky + what surfaces send). The sky is a non-negative sum of wide lobes; albedos are a
mean, which only indirect light tells, times what tells surfaces apart.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from server.maths.lobes import RIDGE
from server.maths.nonnegative_qp import solve_nonnegative
from server.maths.normals import NormalWeights, normal_weights
from server.maths.sh import LUMINANCE
from server.maths.surfaces import Albedos, one_albedo
from server.stages.cell_transfer import Pools
from server.stages.light_estimation import ASSUMED_ALBEDO

Floats = NDArray[np.float64]
Columns = NDArray[np.float32]

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
ONE_COLOR = 0.12
"""Root mean square scatter of reflected colours, as logarithms of ratios, that counts as one colour."""
_DARK = 1e-4


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
class Frame:
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
class Rows:
    """All pools in use, frame by frame."""

    slots: NDArray[np.int64]
    places: NDArray[np.int64]
    """[n] of the window, and in it."""
    columns: Columns
    """[n, lobes] shading of white surface under each lobe."""
    seen: Floats
    """[n, 3] radiance."""
    sent: Floats
    """[n, 3] what surfaces send to white surface."""
    unseen: Floats
    """[n] share of the sky that is surface no picture shows."""
    weights: Floats
    """[n]."""

    @property
    def luminance(self) -> Floats:
        """[n] of what was seen."""
        return np.asarray(self.seen @ LUMINANCE)

    @property
    def sent_luminance(self) -> Floats:
        """[n] of what surfaces send."""
        return np.asarray(self.sent @ LUMINANCE)


@dataclass(frozen=True)
class Solution:
    """Light as amounts of the widest family, for relative albedos, and the mean albedo."""

    amounts: Floats
    """[lobes] of luminance."""
    colors: Floats
    """[lobes, 3]."""
    mean_albedo: float


def rows_of(frames: dict[int, Frame], normals: NormalWeights) -> Rows:
    """Pools of `frames` that count."""
    parts = []
    for slot, frame in sorted(frames.items()):
        pools = frame.pools
        places = np.flatnonzero((pools.weights > 0) & (frame.keep > 1e-3))
        factor = normal_weights(pools.normals[places], pools.weights[places], normals)
        share, beyond = pools.weights[places], frame.continued[places]
        parts.append(
            (np.full(len(places), slot), places, frame.columns[places, :-1], pools.seen[places],
             pools.sent[places] + beyond[:, None] * pools.beyond, pools.unseen[places] + beyond,
             frame.keep * factor * share)
        )  # fmt: skip
    return Rows(*(np.concatenate(column) for column in zip(*parts, strict=True)))


def weights_of(rows: Rows, solution: Solution | None, albedos: Albedos | None, *, outliers: bool) -> Floats:
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
    if outliers:
        apart = np.abs(luminance / expected - 1.0)
        usual = 1.4826 * float(np.median(apart)) + 0.01
        weights = weights / (1.0 + (apart / (2.0 * usual)) ** 2)
    return np.asarray(weights)


def system_of(rows: Rows, albedos: Albedos, weights: Floats) -> tuple[Floats, Floats, Floats]:
    """Columns [n, lobes + 1] (the last: what surfaces send, times the mean albedo), target [n] and its weights."""
    columns = np.column_stack([rows.columns, rows.sent_luminance])
    return columns, rows.luminance / albedos.lightness, weights * albedos.lightness**2


def solve_amounts(
    columns: Floats, target: Floats, weights: Floats, near: Floats | None = None, hold: float = 0.0
) -> Floats:
    """[lobes + 1] >= 0: amounts, and the mean albedo, drawn to ASSUMED_ALBEDO.

    Drawn to the shape of `near` [lobes] as well, `hold` times as much as pools say of a lobe on average.
    """
    weighted = weights[:, None] * columns
    matrix, vector = weighted.T @ columns, weighted.T @ target
    lobes = len(matrix) - 1
    pull = np.full(lobes + 1, RIDGE * max(float(np.trace(matrix[:lobes, :lobes])) / lobes, 1e-300))
    independent = max(len(target) / ALIKE, 1.0)
    noise = max(float(weights @ target**2) * NOISE**2 / independent, 1e-300)
    if near is not None:
        held = hold / RIDGE * pull[:lobes]
        brightness = float(near @ vector[:lobes]) / max(float(near @ matrix[:lobes, :lobes] @ near), 1e-300)
        pull[:lobes] += held
        vector[:lobes] += held * brightness * near
    pull[-1] = noise / ALBEDO_SPREAD**2
    vector[-1] += pull[-1] * ASSUMED_ALBEDO
    amounts, _ = solve_nonnegative(matrix + np.diag(pull), vector)
    amounts[-1] = np.clip(amounts[-1], *ALBEDO_RANGE)
    return amounts


def with_colors(
    rows: Rows,
    albedos: Albedos,
    weights: Floats,
    amounts: Floats,
    mean_albedo: float,
    pull: float | None,
) -> Solution:
    """The solution with its colours, each channel drawn to a multiple of the luminance by `pull` times the ridge.

    None: each is one, as while surfaces of many colours are looked for, which else would pass for coloured light.
    """
    scaled = weights * albedos.lightness**2
    weighted = scaled[:, None] * rows.columns
    target = rows.seen / (albedos.lightness[:, None] * albedos.color) - mean_albedo * rows.sent
    vectors = weighted.T @ target
    if pull is None:
        along = max(float(scaled @ (rows.columns @ amounts) ** 2), 1e-300)
        return Solution(amounts, amounts[:, None] * np.maximum(amounts @ vectors / along, 0.0), mean_albedo)
    matrix = weighted.T @ rows.columns
    tint = np.maximum(amounts @ vectors / max(float(amounts @ matrix @ amounts), 1e-300), 0.0)
    ridge = RIDGE * max(float(np.trace(matrix)) / len(matrix), 1e-300)
    regular, near = matrix + ridge * (1.0 + pull) * np.eye(len(matrix)), ridge * pull * amounts
    colors = [solve_nonnegative(regular, vectors[:, c] + tint[c] * near, amounts > 0)[0] for c in range(3)]
    return Solution(amounts, np.stack(colors, axis=1), mean_albedo)


def is_of_one_color(rows: Rows) -> bool:
    """Whether coloured light on surfaces of one colour explains all colours.

    If it does, there is no telling it from surfaces of many colours, and colourless rooms under coloured lights are
    the simpler world.
    """
    albedos, weights = one_albedo(len(rows.seen)), weights_of(rows, None, None, outliers=False)
    amounts = solve_amounts(*system_of(rows, albedos, weights))
    mean_albedo = float(amounts[-1])
    colors = with_colors(rows, albedos, weights, amounts[:-1], mean_albedo, pull=0.0).colors
    shading = rows.columns @ colors + mean_albedo * rows.sent
    reflected = np.log(np.maximum(rows.seen, _DARK) / np.maximum(shading, _DARK))
    ratios = reflected[:, [0, 2]] - reflected[:, 1:2]
    apart = np.linalg.norm(ratios - np.median(ratios, axis=0), axis=1)
    return bool(np.sqrt(np.mean(np.minimum(apart, 3 * np.median(apart)) ** 2)) < ONE_COLOR)


def misfit_of(columns: Floats, target: Floats, weights: Floats, amounts: Floats) -> float:
    """Weighted sum of squares that `amounts` leave of `target`."""
    return float(weights @ (target - columns @ amounts) ** 2)
