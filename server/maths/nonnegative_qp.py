"""Non-negative least squares from its normal equations, by block principal pivoting (Kim and Park 2011).

Exact in a few Cholesky factorisations: each exchanges all variables that break the optimality conditions at once, and
falls back to one at a time where that does not get ahead (Portugal, Judice and Vicente 1994).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import lapack

_PATIENCE = 3
_MOST_STEPS = 200
_TOLERANCE = 1e-10

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]


def solve_nonnegative(matrix: Floats, vector: Floats, start: Bools | None = None) -> tuple[Floats, Bools]:
    """The x >= 0 [n] that minimises x^T `matrix` x / 2 - `vector`^T x, and [n] which of it is free to be positive.

    matrix: [n, n] symmetric positive definite. `start`: guess of the free ones, as of a similar problem.
    """
    free = np.zeros(len(vector), np.bool_) if start is None else start.copy()
    slack = _TOLERANCE * max(float(np.abs(vector).max(initial=0.0)), 1e-300)
    least = slack / max(float(np.abs(matrix).max(initial=0.0)), 1e-300)
    patience, fewest = _PATIENCE, len(vector) + 1
    x = np.zeros(len(vector))
    for _ in range(_MOST_STEPS):
        x = _with_free(matrix, vector, free)
        pull = matrix @ x - vector
        wrong = np.where(free, x < -least, pull < -slack)
        count = int(wrong.sum())
        if count == 0:
            break
        if count < fewest:
            fewest, patience = count, _PATIENCE
        elif patience > 0:
            patience -= 1
        else:
            wrong = np.arange(len(wrong)) == np.flatnonzero(wrong)[-1]
        free = free ^ wrong
    return np.maximum(x, 0.0), free


def _with_free(matrix: Floats, vector: Floats, free: Bools) -> Floats:
    x = np.zeros(len(vector))
    some = np.flatnonzero(free)
    if len(some):
        part, wanted = matrix[some[:, None], some], vector[some]
        _, solved, failed = lapack.dposv(part, wanted)  # half the work of LU, and little besides it
        x[some] = np.linalg.solve(part, wanted) if failed else solved
    return x
