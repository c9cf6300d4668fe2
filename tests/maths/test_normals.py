"""Weights by the distribution of normals: the thesis's three stated effects."""

from __future__ import annotations

import numpy as np
import pytest

from server.maths.normals import GREATEST, NormalWeights, normal_weights
from server.maths.sh import spherical_fibonacci
from tests.scenes.analytic import Floats
from tests.scenes.lights import random_directions

UP = np.array([0.0, -1.0, 0.0])
WAYS: list[NormalWeights] = ["none", "even", "printed"]


def table(count: int = 800, rest: int = 200) -> tuple[Floats, Floats]:
    """Normals [n, 3] of a table and of round things on it, and which are of the table."""
    flat = UP + 0.02 * np.random.default_rng(0).normal(size=(count, 3))
    normals = np.concatenate([flat / np.linalg.norm(flat, axis=1, keepdims=True), random_directions(rest, 1)])
    return normals, np.arange(count + rest) < count


def test_one_large_plane_counts_less() -> None:
    normals, is_table = table()
    even = normal_weights(normals, np.ones(len(normals)), "even")
    assert np.median(even[is_table]) < 0.5  # a few lie in another bin
    assert even[is_table].sum() / even.sum() < 0.5 < is_table.mean()


def test_small_surfaces_count_more() -> None:
    normals, is_table = table()
    even = normal_weights(normals, np.ones(len(normals)), "even")
    aside = ~is_table & (normals @ UP < 0.5)
    assert even[aside].min() > 1.0
    assert even[aside].mean() > 1.5


@pytest.mark.parametrize("way", WAYS)
def test_an_even_distribution_changes_nothing(way: NormalWeights) -> None:
    normals = spherical_fibonacci(20000)
    factors = normal_weights(normals, np.ones(len(normals)), way)
    np.testing.assert_allclose(factors, 1.0, atol=0.1)


def test_the_printed_formula_does_the_opposite_of_the_first_two() -> None:
    """Eq. 5.7 as it stands: the plane counts more, what is small less."""
    normals, is_table = table()
    printed = normal_weights(normals, np.ones(len(normals)), "printed")
    assert np.median(printed[is_table]) > 2.0
    assert printed[~is_table & (normals @ UP < 0.5)].max() < 1.0
    assert printed[is_table].sum() / printed.sum() > is_table.mean()


@pytest.mark.parametrize("way", WAYS)
def test_factors_stay_within_bounds(way: NormalWeights) -> None:
    normals = np.concatenate([np.tile(UP, (100000, 1)), random_directions(30, 2)])
    factors = normal_weights(normals, np.ones(len(normals)), way)
    assert factors.min() >= 1 / GREATEST
    assert factors.max() <= GREATEST
    assert len(normal_weights(np.empty((0, 3)), np.empty(0), way)) == 0


def test_crowds_are_of_weight_not_of_number() -> None:
    """A plane of many samples that weigh as much as one is no large plane."""
    normals, is_table = table()
    light = np.where(is_table, 1e-3, 1.0)
    assert normal_weights(normals, light, "even")[is_table].min() > 0.8
    doubled = normal_weights(normals, 2 * light, "even")
    np.testing.assert_allclose(doubled, normal_weights(normals, light, "even"))
