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
_LEAST_SCALE = 1e-100  # of an empty system: its inverse times any ratio is still a finite number


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

    def channels(self, first: int, last: int) -> NormalEquations:
        """The same for channels first to last - 1 alone."""
        return NormalEquations(self.matrix, self.vector[:, first:last], self.energy[first:last], self.count)

    def less(self, known: NDArray[np.float64]) -> NormalEquations:
        """The same with A `known` [n, channels] taken from y."""
        energy = self.energy + np.sum(known * (self.matrix @ known - 2 * self.vector), axis=0)
        return NormalEquations(self.matrix, self.vector - self.matrix @ known, np.maximum(energy, 0.0), self.count)

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
        return np.asarray(self.shape * self.noise[channel])

    def std(self, channel: int) -> NDArray[np.float64]:
        """[n] one standard deviation of `mean[:, channel]`."""
        deviation: NDArray[np.float64] = np.sqrt(np.diag(self.covariance(channel)))
        return deviation


def condition_number(matrix: NDArray[np.float64]) -> float:
    """Ratio of the extreme eigenvalues of a symmetric positive semidefinite matrix; infinite if singular."""
    values = np.linalg.eigvalsh(matrix)
    return float(values[-1] / values[0]) if values[0] > values[-1] * 1e-14 and values[-1] > 0 else float("inf")


def solve_with_evidence(equations: NormalEquations, precision: NDArray[np.float64]) -> Posterior:
    """Posterior of x under prior precisions proportional to `precision` [n] > 0. Finite for any finite sums."""
    system = _Whitened.of(equations, precision)
    ratios = _RATIOS * max(system.values[-1], _LEAST_SCALE)
    misfits = system.misfits(ratios)
    log_det = np.sum(np.log1p(system.values[None, :] / ratios[:, None]), axis=1)
    channels = equations.energy.size
    cost = max(equations.count, 1.0) * np.sum(np.log(misfits), axis=1) + channels * log_det
    return system.posterior(float(ratios[int(np.argmin(cost))]))


def solve_with_ratio(equations: NormalEquations, precision: NDArray[np.float64], ratio: float) -> Posterior:
    """Posterior of x for a given k, or for the least that float64 can tell from none."""
    system = _Whitened.of(equations, precision)
    return system.posterior(max(ratio, system.least_ratio))


def solve_plain(equations: NormalEquations, precision: NDArray[np.float64]) -> Posterior:
    """Plain least squares."""
    system = _Whitened.of(equations, precision)
    return system.posterior(system.least_ratio)


@dataclass(frozen=True)
class _Whitened:
    """The normal equations in the eigenbasis in which prior and data are both diagonal."""

    equations: NormalEquations
    root: NDArray[np.float64]
    values: NDArray[np.float64]
    vectors: NDArray[np.float64]
    projected: NDArray[np.float64]

    @classmethod
    def of(cls, equations: NormalEquations, precision: NDArray[np.float64]) -> _Whitened:
        root = np.sqrt(precision)
        values, vectors = np.linalg.eigh(equations.matrix / np.outer(root, root))
        projected = vectors.T @ (equations.vector / root[:, None])
        return cls(equations, root, np.maximum(values, 0.0), vectors, projected)

    @property
    def least_ratio(self) -> float:
        """The smallest prior that keeps float64 from dividing by zero."""
        return 1e-13 * max(float(self.values[-1]), _LEAST_SCALE)

    def misfits(self, ratios: NDArray[np.float64]) -> NDArray[np.float64]:
        """[ratios, channels] y^T y less what the fits under `ratios` explain; positive."""
        explained = (1 / (self.values + ratios[:, None])) @ self.projected**2
        floor = 1e-12 * self.equations.energy + np.finfo(float).tiny
        return np.asarray(np.maximum(self.equations.energy - explained, floor))

    def posterior(self, ratio: float) -> Posterior:
        gain = self.vectors / (self.values + ratio)
        return Posterior(
            mean=(gain @ self.projected) / self.root[:, None],
            shape=(gain @ self.vectors.T) / np.outer(self.root, self.root),
            noise=self.misfits(np.array([ratio]))[0] / max(self.equations.count, 1.0),
            ratio=ratio,
            condition=condition_number(self.equations.matrix),
        )
