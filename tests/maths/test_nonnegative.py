"""Lights that are not negative, against scipy's constrained minimiser and closed forms."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.optimize import minimize, nnls

from server.maths import nonnegative
from server.maths.nonnegative import faded, nonnegative_mean, nonnegative_sum
from tests.reference.sh import sh_basis, sphere_rule
from tests.scenes import lights

SPHERE = sphere_rule(40, 80)[0]

Floats = NDArray[np.float64]


def values(coefficients: Floats) -> Floats:
    """The function all over the sphere."""
    return sh_basis(SPHERE, round(len(coefficients) ** 0.5)) @ coefficients


def case(seed: int, n: int = 16, *, hard: bool = True) -> tuple[Floats, Floats]:
    """A mean that is negative somewhere and the precision of an ill-conditioned fit (condition 1e4 if hard)."""
    random = np.random.default_rng(seed)
    mean = random.normal(size=n) / (1 + np.sqrt(np.arange(n)))
    mean[0] = 0.5
    rotation = np.linalg.qr(random.normal(size=(n, n)))[0]
    return mean, rotation * np.logspace(0, 4 if hard else 1, n) @ rotation.T


def constraints(n: int) -> Floats:
    return nonnegative._basis(nonnegative._PROBES, round(n**0.5))


@pytest.mark.parametrize("n", [4, 9, 16, 25, 36])
@pytest.mark.parametrize("hard", [False, True])
def test_result_is_not_negative(n: int, hard: bool) -> None:
    negative = 0
    for seed in range(10):
        mean, precision = case(seed, n, hard=hard)
        negative += values(mean).min() < -0.02 * np.abs(mean).max()
        found = values(nonnegative_mean(mean, precision))
        # Zero at 1024 directions: between them, 6 degrees apart, a band of degree l dips by about (l + 1)^2 / 2000.
        assert found.min() > -0.01 * max(1, n / 20) * max(found.max(), 0.05)
    assert negative >= 8


@pytest.mark.parametrize("seed", range(4))
def test_result_is_the_nearest(seed: int) -> None:
    mean, precision = case(seed, hard=False)
    basis = constraints(16)
    best = minimize(
        lambda x: (x - mean) @ precision @ (x - mean),
        np.where(np.arange(16) == 0, 3.0, 0.0),
        jac=lambda x: 2 * precision @ (x - mean),
        constraints={"type": "ineq", "fun": lambda x: basis @ x, "jac": lambda _: basis},
        method="SLSQP",
        options={"maxiter": 500, "ftol": 1e-12},
    )
    assert best.success
    found = nonnegative_mean(mean, precision)
    np.testing.assert_allclose(found, best.x, atol=1e-3)


@pytest.mark.parametrize("seed", range(6))
def test_optimality_of_an_ill_conditioned_fit(seed: int) -> None:
    """Against non-negative least squares on the dual: min over f >= 0 of |L^-1 B^T f + L^T mean|^2."""
    mean, precision = case(seed)
    basis = constraints(16)
    factor = np.linalg.cholesky(precision)
    force, _ = nnls(np.linalg.solve(factor, basis.T), -factor.T @ mean, maxiter=2000)
    best = mean + np.linalg.solve(precision, basis.T @ force)
    assert (basis @ best).min() > -1e-6
    found = nonnegative_mean(mean, precision)

    def cost(x: Floats) -> float:
        return float((x - mean) @ precision @ (x - mean))

    assert (basis @ found).min() > -1e-5 * np.abs(values(mean)).max()
    assert cost(found) == pytest.approx(cost(best), rel=1e-6)
    np.testing.assert_allclose(found, best, atol=1e-4)


def test_a_feasible_mean_is_kept() -> None:
    mean = lights.lobe_and_sky((1, 2, 3))[:, 0]
    np.testing.assert_array_equal(nonnegative_mean(mean, case(1)[1]), mean)


def test_faded_closed_form() -> None:
    # m + a cos: the factor that leaves 0 at the least is m / a. The nearest probe is at most 4 degrees off the least.
    light = lights.uniform((1.0, 1.0, 1.0), 2)
    light[2] = np.array([2.0, 1.0, 0.5]) / np.sqrt(3 / (4 * np.pi))  # a = 2, 1, 0.5
    result = faded(light)
    np.testing.assert_array_equal(result[0], light[0])
    np.testing.assert_allclose(result[1:], 0.5 * light[1:], rtol=4e-3)
    assert values(result).min() > -4e-3


def test_faded_leaves_a_light_alone_that_is_positive() -> None:
    light = lights.lobe_and_sky((0.2, 1.0, -0.3))
    np.testing.assert_array_equal(faded(light), light)


def test_faded_drops_channels_without_a_mean() -> None:
    light = lights.lobe((0, 1, 0), (1.0, -1.0, 0.0))
    np.testing.assert_array_equal(faded(light)[:, 1:], 0)
    np.testing.assert_array_equal(faded(light)[:, 0], light[:, 0])
    np.testing.assert_array_equal(faded(np.zeros((16, 3))), 0)


def test_sum_goes_as_far_as_it_may() -> None:
    base = lights.uniform((1.0, 1.0, 1.0))
    change = np.zeros((16, 3))
    change[2] = np.array([0.5, -0.25, 0.0]) / np.sqrt(3 / (4 * np.pi))  # cos, at most 0.5 of the base
    np.testing.assert_allclose(nonnegative_sum(base, change), base + change, rtol=1e-12)
    np.testing.assert_allclose(nonnegative_sum(base, 4 * change), base + 2 * change, rtol=5e-3, atol=1e-12)
    assert values(nonnegative_sum(base, 100 * change)).min() > -5e-3


def test_nothing_stays_nothing() -> None:
    np.testing.assert_array_equal(nonnegative_sum(np.zeros((16, 3)), np.zeros((16, 3))), 0)
    np.testing.assert_array_equal(nonnegative_mean(np.zeros(16), np.eye(16)), 0)
