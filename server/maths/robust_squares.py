"""Non-negative least squares for samples whose errors are in proportion to what is seen, with outliers among them.

Weights are one over the predicted value squared, times Huber's. `blocks` name the place that each sample belongs to:
what the model leaves out is much the same within a place, so a fit within places gives each an offset of its own.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from server.maths.nonnegative_qp import solve_nonnegative

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]
Blocks = NDArray[np.int64]
"""[n] number of each sample's place, never falling: samples of a place lie beside each other."""

_FLOOR = 4.0  # times the mean prediction: below it an error is no longer in proportion
_HUBER = 1.5  # standard deviations beyond which an error counts linearly
_ROUNDS = 4
_MORE_ROUNDS = 2  # from the weights of a similar fit
_RIDGE = 1e-6


@dataclass(frozen=True)
class Fit:
    """y = columns x + errors."""

    x: Floats
    """[columns] >= 0."""
    weights: Floats
    """[n] the last ones."""
    predicted: Floats
    """[n], a place's offset included where it has one."""


def fit(
    columns: Floats,
    values: Floats,
    used: Bools | None = None,
    blocks: Blocks | None = None,
    start: Fit | None = None,
) -> Fit:
    """Reweighted fit of `values` [n] by `columns` [n, columns]; within `blocks` [n] where they are given.

    Samples out of `used` [n] have no weight. `start`: of a similar problem, perhaps with fewer columns.
    """
    kept = np.ones(len(values)) if used is None else used.astype(np.float64)
    if not kept.any():
        return Fit(np.zeros(columns.shape[1]), kept, np.zeros(len(values)))
    least = _FLOOR * float(values.mean()) + 1e-12
    weights = kept * (start.weights if start else 1 / max(float(values.mean()), 1e-12) ** 2)
    free = np.zeros(columns.shape[1], np.bool_)
    if start is not None:
        free[: len(start.x)] = start.x > 0
    both = np.column_stack([columns, values])
    for _ in range(_MORE_ROUNDS if start else _ROUNDS):
        own = both if blocks is None else centered(both, weights, blocks)
        x, free = solve(*normal_equations(own, weights), free)
        predicted = values - (own[:, -1] - own[:, :-1] @ x)
        scale = np.maximum(predicted, 0.0) + least
        errors = np.abs(values - predicted) / scale
        spread = 1.4826 * float(np.median(errors[kept > 0])) + 1e-9
        weights = kept * np.minimum(1.0, _HUBER * spread / np.maximum(errors, 1e-12)) / scale**2
    return Fit(x, weights, predicted)


def normal_equations(both: Floats, weights: Floats) -> tuple[Floats, Floats]:
    """Matrix [n, n] and vector [n] of a fit of the last of `both` [samples, n + 1] by the others."""
    rooted = both * np.sqrt(weights)[:, None]
    whole = rooted.T @ rooted
    return whole[:-1, :-1], whole[:-1, -1]


def solve(matrix: Floats, vector: Floats, free: Bools | None = None) -> tuple[Floats, Bools]:
    """x >= 0 of normal equations, and which of it is free to be positive; `free`: guess of that."""
    ridge = _RIDGE * np.trace(matrix) / max(len(matrix), 1) + 1e-300
    return solve_nonnegative(matrix + ridge * np.eye(len(matrix)), vector, free)


def centered(matrix: Floats, weights: Floats, blocks: Blocks) -> Floats:
    """[n, columns] less the weighted mean of each block."""
    firsts = np.flatnonzero(np.diff(blocks, prepend=-1))
    total = np.maximum(np.add.reduceat(weights, firsts), 1e-300)
    sums = np.add.reduceat(matrix * weights[:, None], firsts, axis=0)
    numbers = np.repeat(np.arange(len(firsts)), np.diff(firsts, append=len(blocks)))
    return np.asarray(matrix - (sums / total[:, None])[numbers])


def gains(columns: Floats, values: Floats, found: Fit, more: Floats) -> Floats:
    """[candidates] how much of the weighted squared residual one of `more` [candidates, n] explains, beside those
    columns that `found.x` [columns] uses; it must be positive."""
    root = np.sqrt(found.weights)
    used, _ = np.linalg.qr(columns[:, found.x > 0] * root[:, None])
    residual = root * (values - columns @ found.x)
    residual -= used @ (used.T @ residual)
    weighted = more * root
    whole = (weighted**2).sum(axis=1)
    own = whole - ((weighted @ used) ** 2).sum(axis=1)
    pull = weighted @ residual
    return np.where(pull > 0, pull**2 / np.maximum(own, 1e-3 * whole + 1e-300), 0.0)


def gain_at_unseen_places(
    columns: Floats, more: Floats, values: Floats, found: Fit, blocks: Blocks, folds: int
) -> float:
    """1 - (error with / error without)^2 of the column `more` [n], at places left out of the fit, one fold at a time.

    Errors are within places, in units of `found`'s weights, which both fits share.
    """
    fold = np.random.default_rng(1).permutation(int(blocks.max(initial=0)) + 1)[blocks] % folds
    own = centered(np.column_stack([columns, more, values]), found.weights, blocks)
    parts = [normal_equations(own[fold == k], found.weights[fold == k]) for k in range(folds)]
    matrix, vector = sum(part[0] for part in parts), sum(part[1] for part in parts)
    free: list[Bools | None] = [None, None]
    errors = np.zeros(2)
    for k, (left_matrix, left_vector) in enumerate(parts):
        left = fold == k
        for which, count in enumerate((columns.shape[1], columns.shape[1] + 1)):
            kept = (matrix - left_matrix)[:count, :count], (vector - left_vector)[:count]
            x, free[which] = solve(*kept, free[which])
            rest = own[left, -1] - own[left, :count] @ x
            errors[which] += np.abs(np.sqrt(found.weights[left]) * rest).sum()
    return float(1 - (errors[1] / max(errors[0], 1e-300)) ** 2)
