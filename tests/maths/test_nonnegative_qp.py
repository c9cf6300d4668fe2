"""Non-negative least squares against SciPy's, and on systems that make pivoting cycle."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.optimize import nnls

from server.maths.nonnegative_qp import solve_nonnegative


@pytest.mark.parametrize("seed", range(20))
@pytest.mark.parametrize(
    ("rows", "columns", "likeness"), [(40, 10, 0.0), (300, 60, 0.0), (300, 60, 0.98), (80, 80, 0.5)]
)
def test_equals_scipy(seed: int, rows: int, columns: int, likeness: float) -> None:
    """`likeness`: how alike the columns are."""
    rng = np.random.default_rng(seed)
    a = (1 - likeness) * rng.normal(size=(rows, columns)) + likeness * rng.normal(size=(rows, 1))
    y = rng.normal(size=rows)
    expected, _ = nnls(a, y)
    found, free = solve_nonnegative(a.T @ a, a.T @ y)
    assert (found >= 0).all()
    assert not found[~free].any()
    np.testing.assert_allclose(a @ found, a @ expected, atol=1e-6 * np.linalg.norm(y))


def test_a_good_guess_changes_nothing() -> None:
    rng = np.random.default_rng(1)
    a, y = rng.normal(size=(50, 20)), rng.normal(size=50)
    found, free = solve_nonnegative(a.T @ a, a.T @ y)
    for start in (free, ~free, np.ones(20, bool)):
        again, _ = solve_nonnegative(a.T @ a, a.T @ y, start)
        np.testing.assert_allclose(again, found, atol=1e-9)


def test_nothing_to_explain_is_darkness() -> None:
    for vector in (np.zeros(5), -np.ones(5)):
        found, free = solve_nonnegative(np.eye(5), vector)
        assert not found.any()
        assert not free.any()
