"""Light estimation in any basis (B9): the estimator's sums, its prior and its evidence, see stages.light_estimation."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from server.light.light_estimation import ASSUMED_ALBEDO, TileSums, sample_dependence
from server.maths.bayes import NormalEquations, solve_with_evidence, solve_with_ratio
from server.maths.nonnegative import nonnegative_mean
from server.maths.nonnegative_qp import solve_nonnegative
from tests.bench.bases.bases import Basis

Floats = NDArray[np.float64]

_DEPENDENCE_STEPS = 2


def estimate_light(tiles: TileSums, basis: Basis, strength: float = 1.0) -> tuple[Floats, Floats]:
    """Coefficients [size, 3] of the most probable light, and the same of those that are nowhere negative.

    Luminance says how strong the prior is, and how many samples count as one; `strength` times that is taken.
    """
    precision = basis.precision()
    root = np.linalg.inv(np.linalg.cholesky(precision))  # c = root^T x: the prior of x is even
    even = np.ones(basis.size)
    sums = _turned(tiles.total(), root)
    dependence = 1.0
    for _ in range(_DEPENDENCE_STEPS):
        luminance = solve_with_evidence(sums.channels(0, 1).scaled(1 / dependence), even)
        ridge = dependence * luminance.ratio * precision
        dependence = sample_dependence(tiles, root.T @ luminance.mean[:, 0], ridge)
    thinned = sums.channels(1, 4).scaled(1 / dependence)
    ratio = solve_with_evidence(sums.channels(0, 1).scaled(1 / dependence), even).ratio
    free = solve_with_ratio(thinned, even, strength * ratio)
    mean = root.T @ free.mean
    information = tiles.total().matrix / dependence + free.ratio * precision
    bounded = nearest_nonnegative(basis, mean, information)
    return mean / ASSUMED_ALBEDO, bounded / ASSUMED_ALBEDO


def nearest_nonnegative(basis: Basis, mean: Floats, information: Floats) -> Floats:
    """[size, channels] the light nearest to `mean` in the metric of `information` [size, size] that is not negative.

    By the basis's own amounts, which must not be negative; for spherical harmonics by their values all around.
    """
    channels = mean.T
    if basis.from_amounts is None:
        return np.stack([nonnegative_mean(channel, information) for channel in channels], axis=1)
    shape = basis.from_amounts
    matrix = shape.T @ information @ shape
    amounts = [solve_nonnegative(matrix, shape.T @ information @ channel)[0] for channel in channels]
    return np.asarray(shape @ np.stack(amounts, axis=1))


def _turned(sums: NormalEquations, root: Floats) -> NormalEquations:
    """The sums for x, where coefficients are root^T x."""
    return NormalEquations(root @ sums.matrix @ root.T, root @ sums.vector, sums.energy, sums.count)
