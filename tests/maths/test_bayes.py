"""Regularised least squares against closed forms, and what it says of noise and uncertainty against simulations."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.stats import multivariate_normal

from server.maths.bayes import (
    NormalEquations,
    condition_number,
    solve_plain,
    solve_with_evidence,
    solve_with_ratio,
)

PRECISION = 1.0 + np.array([0, 2, 2, 2, 6, 6, 6, 6, 6])

Floats = NDArray[np.float64]


def problem(seed: int, count: int = 300, noise: float = 0.1, channels: int = 1) -> tuple[Floats, Floats, Floats]:
    """A [count, 9], x drawn from the prior [9, channels], y = A x + noise."""
    random = np.random.default_rng(seed)
    a = random.normal(size=(count, 9)) * np.linspace(1.5, 0.2, 9)
    x = random.normal(size=(9, channels)) / np.sqrt(PRECISION)[:, None]
    return a, x, a @ x + noise * random.normal(size=(count, channels))


def equations(a: Floats, y: Floats) -> NormalEquations:
    return NormalEquations(a.T @ a, a.T @ y, (y * y).sum(0), len(a))


@pytest.mark.parametrize("ratio", [1e-6, 0.1, 30.0])
def test_posterior_is_the_closed_form(ratio: float) -> None:
    a, _, y = problem(1, channels=3)
    found = solve_with_ratio(equations(a, y), PRECISION, ratio)
    inverse = np.linalg.inv(a.T @ a + ratio * np.diag(PRECISION))
    np.testing.assert_allclose(found.mean, inverse @ a.T @ y, rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(found.shape, inverse, rtol=1e-9, atol=1e-12)
    # y^T (I + A P^-1 A^T / k)^-1 y / n: the noise that the marginal likelihood of y has its maximum at.
    marginal = np.eye(len(a)) + a / PRECISION @ a.T / ratio
    np.testing.assert_allclose(found.noise, (y * np.linalg.solve(marginal, y)).sum(0) / len(a), rtol=1e-8)
    np.testing.assert_allclose(found.covariance(1), inverse * found.noise[1], rtol=1e-9, atol=1e-15)
    np.testing.assert_allclose(found.std(2) ** 2, np.diag(inverse) * found.noise[2], rtol=1e-9)
    assert found.condition == pytest.approx(np.linalg.cond(a.T @ a), rel=1e-6)


@pytest.mark.parametrize("noise", [0.01, 0.3, 3.0])
def test_evidence_is_greatest_at_the_chosen_ratio(noise: float) -> None:
    a, _, y = problem(2, count=60, noise=noise)
    found = solve_with_evidence(equations(a, y), PRECISION)

    def log_evidence(ratio: float) -> float:
        marginal = np.eye(len(a)) + a / PRECISION @ a.T / ratio
        variance = float(y[:, 0] @ np.linalg.solve(marginal, y[:, 0])) / len(a)
        return float(multivariate_normal(cov=variance * marginal).logpdf(y[:, 0]))

    best = max(log_evidence(found.ratio * factor) for factor in np.logspace(-3, 3, 61))
    # Candidates lie a factor of 1.26 apart; half of that changes a smooth maximum's logarithm by less than 0.05.
    assert log_evidence(found.ratio) > best - 0.05


@pytest.mark.parametrize("noise", [0.003, 0.1, 1.0])
def test_noise_is_recovered(noise: float) -> None:
    a, _, y = problem(3, count=3000, noise=noise)
    variance = solve_with_evidence(equations(a, y), PRECISION).noise[0]
    # The sample variance of 3000 draws is itself good to 2.6 %.
    assert variance == pytest.approx(noise**2, rel=0.1)


def test_intervals_hold_what_they_say() -> None:
    inside = []
    for seed in range(200):
        a, x, y = problem(100 + seed, count=150, noise=0.3)
        found = solve_with_evidence(equations(a, y), PRECISION)
        inside.append(np.abs(x[:, 0] - found.mean[:, 0]) < 1.96 * found.std(0))
    # 1800 intervals: 95 % give or take 1 % by chance; the noise and the prior are estimated too.
    assert 0.9 < np.mean(inside) < 0.99


def test_sums_are_the_samples() -> None:
    a, _, y = problem(4, channels=3)
    b, _, z = problem(5, channels=3)
    both = equations(np.vstack([a, b]), np.vstack([y, z]))
    total = equations(a, y) + equations(b, z)
    for name in ("matrix", "vector", "energy", "count"):
        np.testing.assert_allclose(getattr(total, name), getattr(both, name), rtol=1e-12)
    known = np.random.default_rng(6).normal(size=(9, 3))
    less = equations(a, y).less(known)
    rest = equations(a, y - a @ known)
    np.testing.assert_allclose(less.vector, rest.vector, atol=1e-9)
    np.testing.assert_allclose(less.energy, rest.energy, rtol=1e-9)
    half = equations(a, y).scaled(0.5).channels(1, 3)
    np.testing.assert_allclose(half.vector, 0.5 * (a.T @ y)[:, 1:3], rtol=1e-12)
    assert half.energy.shape == (2,)


def test_plain_is_least_squares() -> None:
    a, _, y = problem(7)
    np.testing.assert_allclose(
        solve_plain(equations(a, y), PRECISION).mean, np.linalg.lstsq(a, y, rcond=None)[0], rtol=1e-8
    )


@pytest.mark.parametrize("solve", [solve_with_evidence, solve_plain])
def test_one_normal_is_finite_and_said_to_be_singular(solve: object) -> None:
    a = np.tile(np.random.default_rng(8).normal(size=9), (500, 1))
    found = solve(equations(a, a @ np.ones((9, 1))), PRECISION)  # type: ignore[operator]
    assert found.condition == float("inf")
    assert np.isfinite(found.mean).all()
    assert np.isfinite(found.std(0)).all()
    np.testing.assert_allclose(a[:1] @ found.mean, a[:1] @ np.ones((9, 1)), rtol=1e-3)  # what is seen is explained


@pytest.mark.parametrize("solve", [solve_with_evidence, solve_plain])
@pytest.mark.parametrize("count", [0.0, 100.0])
def test_nothing_is_finite(solve: object, count: float) -> None:
    nothing = NormalEquations(np.zeros((9, 9)), np.zeros((9, 1)), np.zeros(1), count)
    found = solve(nothing, PRECISION)  # type: ignore[operator]
    np.testing.assert_array_equal(found.mean, 0)
    assert np.isfinite(found.noise).all()
    assert np.isfinite(found.std(0)).all()
    assert found.condition == float("inf")


@pytest.mark.parametrize("scale", [1e-12, 1e12])
def test_units_do_not_matter(scale: float) -> None:
    a, _, y = problem(9)
    found, scaled = (solve_with_evidence(equations(a, s * y), PRECISION) for s in (1.0, scale))
    np.testing.assert_allclose(scaled.mean, scale * found.mean, rtol=1e-6)
    np.testing.assert_allclose(scaled.std(0), scale * found.std(0), rtol=1e-6)


def test_perfect_data_is_exact() -> None:
    a, x, _ = problem(10)
    np.testing.assert_allclose(solve_with_evidence(equations(a, a @ x), PRECISION).mean, x, rtol=1e-6)


def test_condition_number() -> None:
    assert condition_number(np.diag([4.0, 2.0, 1.0])) == pytest.approx(4)
    assert condition_number(np.diag([1.0, 0.0])) == float("inf")
    assert condition_number(np.diag([1.0, 1e-13, 1e-13])) == pytest.approx(1e13)
    assert condition_number(np.diag([1.0, 1.0, 1e-15])) == float("inf")
    assert condition_number(np.diag([1.0, -1e-20])) == float("inf")
    assert condition_number(np.zeros((3, 3))) == float("inf")
