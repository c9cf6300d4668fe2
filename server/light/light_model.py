"""The model that light estimation in a room fits, and its parts, each solved given the others.

Model: radiance = albedo (visible sky + what surfaces send). The sky is a non-negative sum of wide lobes; albedos are a
mean, which only indirect light tells, times what tells surfaces apart.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from server.light.cell_transfer import Pools
from server.light.light_estimation import ASSUMED_ALBEDO
from server.maths.lobes import RIDGE
from server.maths.nonnegative_qp import solve_nonnegative
from server.maths.normals import NormalWeights, normal_weights
from server.maths.sh import LUMINANCE
from server.maths.surfaces import Albedos, one_albedo

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]
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

    @cached_property
    def luminance(self) -> Floats:
        """[n] of what was seen."""
        return np.asarray(self.seen @ LUMINANCE)

    @cached_property
    def sent_luminance(self) -> Floats:
        """[n] of what surfaces send."""
        return np.asarray(self.sent @ LUMINANCE)

    def under(self, amounts: Floats) -> Floats:
        """[n, ...] what of lobes `amounts` [lobes, ...] white surface would show. To float32."""
        return (self.columns @ amounts.astype(np.float32)).astype(np.float64)

    def shading(self, solution: Solution) -> Floats:
        """[n, 3] what white surface would show of all light, if others have the mean albedo."""
        return self.under(solution.colors) + solution.mean_albedo * self.sent


@dataclass(frozen=True)
class Sums:
    """Weighted sums over pools, summed as float32. Columns: shading under each lobe, then what surfaces send."""

    matrix: Floats
    """[lobes + 1, lobes + 1] of the columns' products."""
    vector: Floats
    """[lobes + 1] of the columns times luminance over albedo."""
    energy: float
    """Of that squared."""
    seen: Floats
    """[lobes, 3] of the lobes times colour over albedo."""
    sent: Floats
    """[lobes, 3] of the lobes times what surfaces send."""
    count: int
    """Pools."""


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
    explained = rows.under(solution.amounts) + solution.mean_albedo * rows.sent_luminance
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


def sums_of(rows: Rows, albedos: Albedos, weights: Floats) -> Sums:
    """The sums that light is solved from, if surfaces have `albedos`; weights: [n] of residuals in radiance."""
    lightness, lobes = albedos.lightness, rows.columns.shape[1]
    roots = np.sqrt(weights) * lightness
    columns = np.empty((len(roots), lobes + 1), np.float32)
    np.multiply(rows.columns, roots.astype(np.float32)[:, None], out=columns[:, :lobes])
    columns[:, lobes] = roots * rows.sent_luminance
    targets = np.empty((len(roots), 7), np.float32)
    targets[:, 0] = roots * rows.luminance / lightness
    targets[:, 1:4] = rows.seen * (roots / lightness)[:, None] / albedos.color
    targets[:, 4:] = rows.sent * roots[:, None]
    matrix, vectors = ((columns.T @ other).astype(np.float64) for other in (columns, targets))
    energy = float(np.square(targets[:, 0], dtype=np.float64).sum())
    return Sums(matrix, vectors[:, 0], energy, vectors[:lobes, 1:4], vectors[:lobes, 4:], len(roots))


def solve_amounts(
    sums: Sums, near: Floats | None = None, hold: float = 0.0, lit: Bools | None = None
) -> tuple[Floats, Bools]:
    """[lobes + 1] >= 0: amounts, and the mean albedo, drawn to ASSUMED_ALBEDO; and which of them may be positive.

    Drawn to the shape of `near` [lobes] as well, `hold` times as much as pools say of a lobe on average. lit: guess of
    what may be positive. It saves time and changes nothing.
    """
    matrix, vector, lobes = sums.matrix, sums.vector.copy(), len(sums.matrix) - 1
    pull = np.full(lobes + 1, RIDGE * max(float(np.trace(matrix[:lobes, :lobes])) / lobes, 1e-300))
    independent = max(sums.count / ALIKE, 1.0)
    noise = max(sums.energy * NOISE**2 / independent, 1e-300)
    if near is not None:
        held = hold / RIDGE * pull[:lobes]
        brightness = float(near @ vector[:lobes]) / max(float(near @ matrix[:lobes, :lobes] @ near), 1e-300)
        pull[:lobes] += held
        vector[:lobes] += held * brightness * near
    pull[-1] = noise / ALBEDO_SPREAD**2
    vector[-1] += pull[-1] * ASSUMED_ALBEDO
    amounts, lit = solve_nonnegative(matrix + np.diag(pull), vector, lit)
    amounts[-1] = np.clip(amounts[-1], *ALBEDO_RANGE)
    return amounts, lit


def with_colors(sums: Sums, amounts: Floats, mean_albedo: float, pull: float | None) -> Solution:
    """The solution with its colours, each channel drawn to a multiple of the luminance by `pull` times the ridge.

    None: each is one, as while surfaces of many colours are looked for, which else would pass for coloured light.
    """
    lobes = len(amounts)
    matrix, vectors = sums.matrix[:lobes, :lobes], sums.seen - mean_albedo * sums.sent
    tint = np.maximum(amounts @ vectors / max(float(amounts @ matrix @ amounts), 1e-300), 0.0)
    if pull is None:
        return Solution(amounts, amounts[:, None] * tint, mean_albedo)
    ridge = RIDGE * max(float(np.trace(matrix)) / lobes, 1e-300)
    regular, near = matrix + ridge * (1.0 + pull) * np.eye(lobes), ridge * pull * amounts
    colors = [solve_nonnegative(regular, vectors[:, c] + tint[c] * near, amounts > 0)[0] for c in range(3)]
    return Solution(amounts, np.stack(colors, axis=1), mean_albedo)


def is_of_one_color(rows: Rows) -> bool:
    """Whether coloured light on surfaces of one colour explains all colours.

    If it does, there is no telling it from surfaces of many colours, and colourless rooms under coloured lights are
    the simpler world.
    """
    sums = sums_of(rows, one_albedo(len(rows.seen)), weights_of(rows, None, None, outliers=False))
    amounts, _ = solve_amounts(sums)
    solution = with_colors(sums, amounts[:-1], float(amounts[-1]), pull=0.0)
    reflected = np.log(np.maximum(rows.seen, _DARK) / np.maximum(rows.shading(solution), _DARK))
    ratios = reflected[:, [0, 2]] - reflected[:, 1:2]
    apart = np.linalg.norm(ratios - np.median(ratios, axis=0), axis=1)
    return bool(np.sqrt(np.mean(np.minimum(apart, 3 * np.median(apart)) ** 2)) < ONE_COLOR)


def misfit_of(columns: Floats, target: Floats, weights: Floats, amounts: Floats) -> float:
    """Weighted sum of squares that `amounts` leave of `target`."""
    return float(weights @ (target - columns @ amounts) ** 2)
