"""Linear least squares with a Gaussian prior whose strength is chosen from the data.

Model: y = A x + noise of variance s^2, x_i ~ N(0, t^2 / p_i). The ratio k = s^2 / t^2 maximises the evidence p(y | k)
with s^2 profiled out (MacKay 1992). Only the normal equations are needed.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

_RATIOS = np.logspace(-10, 2, 121)
"""Candidates of k relative to the largest eigenvalue: from no prior in float64 terms to nothing but the prior."""


@dataclass(frozen=True)
class NormalEquations:
    """Sums over samples with weight w: enough for the least-squares problem and its residual."""

    matrix: NDArray[np.float64]
    """[n, n] sum w a a^T."""
    vector: NDArray[np.float64]
    """[n, channels] sum w a y."""
    energy: NDArray[np.float64]
    """[channels] sum w y^2."""
    count: float
    """Number of samples, not of independent ones."""

    def scaled(self, factor: float) -> NormalEquations:
        """Every sum times `factor`."""
        return NormalEquations(self.matrix * factor, self.vector * factor, self.energy * factor, self.count * factor)

    def __add__(self, other: NormalEquations) -> NormalEquations:
        return NormalEquations(
            self.matrix + other.matrix,
            self.vector + other.vector,
            self.energy + other.energy,
            self.count + other.count,
        )


@dataclass(frozen=True)
class Posterior:
    """What the data and the prior say of x."""

    mean: NDArray[np.float64]
    """[n, channels]."""
    shape: NDArray[np.float64]
    """[n, n] covariance for noise of variance 1."""
    noise: NDArray[np.float64]
    """[channels] variance of the noise of one sample."""
    ratio: float
    """The chosen k: prior precision in units of the noise's."""
    condition: float
    """Condition number of the normal matrix without the prior; infinite if it is singular."""

    def covariance(self, channel: int) -> NDArray[np.float64]:
        """[n, n] covariance of `mean[:, channel]`."""
        return self.shape * self.noise[channel]


def condition_number(matrix: NDArray[np.float64]) -> float:
    """Ratio of the extreme eigenvalues of a symmetric positive semidefinite matrix; infinite if singular."""
    values = np.linalg.eigvalsh(matrix)
    return float(values[-1] / values[0]) if values[0] > values[-1] * 1e-14 and values[-1] > 0 else float("inf")


def solve_with_evidence(equations: NormalEquations, precision: NDArray[np.float64]) -> Posterior:
    """Posterior of x under prior precisions proportional to `precision` [n] > 0. Finite for any finite sums."""
    root = np.sqrt(precision)
    values, vectors = np.linalg.eigh(equations.matrix / np.outer(root, root))
    values = np.maximum(values, 0.0)
    projected = vectors.T @ (equations.vector / root[:, None])
    channels = equations.energy.size
    ratios = _RATIOS * max(values[-1], np.finfo(float).tiny)
    explained = np.einsum("ic,ki->kc", projected**2, 1 / (values[None, :] + ratios[:, None]))
    floor = 1e-12 * equations.energy + np.finfo(float).tiny
    misfit = np.maximum(equations.energy[None, :] - explained, floor[None, :])
    count = max(equations.count, 1.0)
    log_det = np.sum(np.log1p(values[None, :] / ratios[:, None]), axis=1)
    cost = count * np.sum(np.log(misfit), axis=1) + channels * log_det
    best = int(np.argmin(cost))
    ratio = float(ratios[best])
    gain = vectors / (values + ratio)
    return Posterior(
        mean=(gain @ projected) / root[:, None],
        shape=(gain @ vectors.T) / np.outer(root, root),
        noise=misfit[best] / count,
        ratio=ratio,
        condition=condition_number(equations.matrix),
    )
