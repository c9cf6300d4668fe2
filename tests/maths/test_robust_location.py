"""Where most of many numbers lie: against known distributions, with half of them meaning something else."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest

from server.maths.robust_location import robust_location, shortest_part

LEAST_SCALE = 0.005


def located(values: np.ndarray, near: float = 0.0, weights: np.ndarray | None = None, group: int = 1) -> tuple:
    result = robust_location(
        values, np.ones(len(values)) if weights is None else weights, np.arange(len(values)) // group, near, LEAST_SCALE
    )
    return result.value, result.std, result.scale, result.share


@pytest.mark.parametrize("share", [0.3, 0.5])
@pytest.mark.parametrize("seed", range(4))
def test_shortest_part_is_the_shortest(seed: int, share: float) -> None:
    """Against every interval between two values."""
    rng = np.random.default_rng(seed)
    values, weights = rng.normal(size=41), rng.uniform(0.1, 2.0, 41)
    intervals = [
        (high - low, 0.5 * (low + high))
        for low in values
        for high in values
        if weights[(values >= low) & (values <= high)].sum() >= share * weights.sum()
    ]
    width, middle = min(intervals)
    assert shortest_part(values, weights, share) == pytest.approx((middle, width))


def test_mean_of_normal_errors_with_its_deviation() -> None:
    """Over 300 trials: as good as the mean to 10 %, and the deviation told is the one there is."""
    rng = np.random.default_rng(1)
    found = [located(rng.normal(0.3, 0.05, 200), near=0.3) for _ in range(300)]
    values, stds, scales, shares = np.array(found).T
    assert abs(values.mean() - 0.3) < 4 * 0.05 / np.sqrt(200 * 300)
    assert values.std() < 1.1 * 0.05 / np.sqrt(200)
    assert stds.mean() == pytest.approx(values.std(), rel=0.2)
    assert scales.mean() == pytest.approx(0.05, rel=0.15)
    assert shares.mean() == pytest.approx(0.954, abs=0.06)


def test_errors_that_a_group_shares_are_counted_once() -> None:
    rng = np.random.default_rng(2)
    found = [located(np.repeat(rng.normal(0, 0.05, 40), 25) + rng.normal(0, 0.005, 1000), group=25) for _ in range(200)]
    values, stds, *_ = np.array(found).T
    assert stds.mean() == pytest.approx(values.std(), rel=0.25)
    assert values.std() > 3 * 0.05 / np.sqrt(1000)


@pytest.mark.parametrize("share", [0.3, 0.5, 0.6])
def test_a_large_part_under_another_light_is_not_followed(share: float) -> None:
    """Up to two thirds of it, while the rest is where the last frame was."""
    rng = np.random.default_rng(3)
    values = rng.normal(0.0, 0.03, 1000)
    values[: int(share * 1000)] += 0.5
    value, std, *_ = located(values)
    assert abs(value) < 5 * 0.03 / np.sqrt(400)
    assert std < 0.004


def test_all_that_moved_is_followed() -> None:
    """However far it went, and with a third that means something else."""
    rng = np.random.default_rng(4)
    for moved in (0.05, 0.7, -2.0):
        values = rng.normal(moved, 0.03, 900)
        values[:300] = rng.uniform(-3, 3, 300)
        assert abs(located(values)[0] - moved) < 0.01


def test_weights_decide() -> None:
    values = np.repeat([0.0, 1.0], 100) + np.random.default_rng(5).normal(0, 0.01, 200)
    heavy = np.repeat([0.2, 1.0], 100)
    assert abs(located(values, near=5.0, weights=heavy)[0] - 1) < 0.01
    assert abs(located(values, near=5.0, weights=heavy[::-1])[0]) < 0.01


def test_equal_values_are_exact_and_nothing_is_divided_by_nothing() -> None:
    for value in (0.0, 0.7):
        assert located(np.full(120, value))[:2] == pytest.approx((value, 0.0), abs=1e-12)
    spread = np.linspace(-3, 3, 101)
    assert all(np.isfinite(located(spread)))
    assert all(b > a for a, b in pairwise(located(spread * k)[2] for k in (0.1, 1.0, 10.0)))
