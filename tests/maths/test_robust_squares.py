"""Robust non-negative fits: outliers and offsets of places do not turn them."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.optimize import nnls

from server.maths.robust_squares import Fit, centered, fit, gains, normal_equations, solve


@pytest.mark.parametrize("seed", range(5))
def test_solve_against_scipy(seed: int) -> None:
    random = np.random.default_rng(seed)
    matrix, weights = random.normal(size=(60, 10)) + 0.5, random.uniform(0.1, 1, 60)
    values = matrix @ np.maximum(random.normal(size=10), 0) + 0.5 * random.normal(size=60)
    x, free = solve(*normal_equations(np.column_stack([matrix, values]), weights))
    root = np.sqrt(weights)
    np.testing.assert_allclose(x, nnls(matrix * root[:, None], values * root)[0], atol=1e-4)
    np.testing.assert_array_equal(free, x > 0)


def test_outliers_and_offsets_do_not_turn_a_fit() -> None:
    random = np.random.default_rng(2)
    columns, truth = random.uniform(size=(300, 4)), np.array([1.0, 0.0, 2.0, 0.5])
    values = columns @ truth
    values[::20] *= 3
    plain = fit(columns, values)
    np.testing.assert_allclose(plain.x, truth, atol=0.05)
    blocks = np.sort(random.integers(0, 7, 300))
    offset = random.uniform(0, 2, 7)[blocks]
    np.testing.assert_allclose(fit(columns, values + offset, None, blocks).x, truth, atol=0.05)
    used = np.arange(300) % 20 > 0
    np.testing.assert_allclose(fit(columns, values, used).x, truth, atol=1e-4)


def test_start_shortens_the_way_to_the_same_fit() -> None:
    random = np.random.default_rng(4)
    columns, truth = random.uniform(size=(300, 4)), np.array([1.0, 0.0, 2.0, 0.5])
    values = columns @ truth * (1 + 0.05 * random.normal(size=300))
    whole = fit(columns, values)
    fewer = fit(columns[:, :3], values)
    np.testing.assert_allclose(fit(columns, values, start=whole).x, whole.x, atol=0.005)
    np.testing.assert_allclose(fit(columns, values, start=fewer).x, whole.x, atol=0.02)


def test_centered_takes_weighted_means() -> None:
    random = np.random.default_rng(3)
    matrix, weights = random.normal(size=(50, 3)), random.uniform(size=50)
    blocks = np.sort(np.arange(50) % 4)
    result = centered(matrix, weights, blocks)
    for block in range(4):
        here = blocks == block
        np.testing.assert_allclose(weights[here] @ result[here], 0, atol=1e-12)
        np.testing.assert_allclose(np.ptp(matrix[here] - result[here], axis=0), 0, atol=1e-12)


def test_gain_is_the_fall_of_the_squared_error() -> None:
    random = np.random.default_rng(5)
    columns, more, weights = random.normal(size=(80, 3)), random.normal(size=(6, 80)), random.uniform(0.1, 1, 80)
    values = columns @ [1.0, 2.0, 0.5] + 0.7 * more[0] - 0.4 * more[1] + 0.1 * random.normal(size=80)
    root = np.sqrt(weights)

    def left(matrix: np.ndarray) -> tuple[np.ndarray, float]:
        x, rest, *_ = np.linalg.lstsq(matrix * root[:, None], values * root)
        return x, float(rest[0])

    x, without = left(columns)
    found = gains(columns, values, Fit(x, weights, columns @ x), more)
    for candidate, gain in zip(more, found, strict=True):
        both, error = left(np.column_stack([columns, candidate]))
        assert gain == pytest.approx(without - error if both[-1] > 0 else 0.0, rel=1e-9, abs=1e-9)


def test_no_sample_in_use_is_no_light() -> None:
    columns = np.random.default_rng(6).uniform(size=(30, 4))
    found = fit(columns, columns.sum(1), np.zeros(30, bool))
    assert not found.x.any()
    assert not found.weights.any()
