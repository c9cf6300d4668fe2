"""The light's sums and their solutions: against every pool written out, in float64, by other solvers."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.optimize import nnls

from server.light.light_estimation import ASSUMED_ALBEDO
from server.light.light_model import (
    ALBEDO_RANGE,
    ALBEDO_SPREAD,
    ALIKE,
    NOISE,
    Rows,
    Solution,
    solve_amounts,
    sums_of,
    with_colors,
)
from server.maths.lobes import RIDGE
from server.maths.sh import LUMINANCE
from server.maths.surfaces import Albedos
from tests.scenes.analytic import Floats

POOLS, LOBES = 700, 9


def pools(seed: int = 1) -> tuple[Rows, Albedos, Floats, Solution]:
    """Random pools, what they reflect, their weights, and the light that they show, but for 2 %."""
    rng = np.random.default_rng(seed)
    columns = rng.random((POOLS, LOBES)).astype(np.float32)
    sent = rng.uniform(0, 2.0, (POOLS, 3))
    lightness, color = rng.uniform(0.5, 1.5, POOLS), rng.uniform(0.5, 1.5, (POOLS, 3))
    color /= (color @ LUMINANCE)[:, None]
    amounts = np.where(np.arange(LOBES) % 3 > 0, rng.uniform(0.2, 1.0, LOBES), 0.0)
    light = Solution(amounts, np.outer(amounts, [1.2, 1.0, 0.6]), 0.4)
    seen = lightness[:, None] * color * (columns @ light.colors + light.mean_albedo * sent)
    seen *= 1 + 0.02 * rng.normal(size=seen.shape)
    zeros = np.zeros(POOLS, np.int64)
    rows = Rows(zeros, np.arange(POOLS), columns, seen, sent, np.zeros(POOLS), np.ones(POOLS))
    return rows, Albedos(lightness, color, 1), rng.uniform(0.1, 1.0, POOLS), light


def written_out(rows: Rows, albedos: Albedos, weights: Floats) -> tuple[Floats, Floats, Floats]:
    """Columns [n, lobes + 1], luminance over albedo [n], and the square roots of its weights [n]."""
    columns = np.column_stack([rows.columns.astype(np.float64), rows.sent @ LUMINANCE])
    return columns, rows.seen @ LUMINANCE / albedos.lightness, np.sqrt(weights) * albedos.lightness


def test_sums_are_those_of_every_pool() -> None:
    rows, albedos, weights, _ = pools()
    sums = sums_of(rows, albedos, weights)
    columns, target, root = written_out(rows, albedos, weights)
    scaled = root[:, None] ** 2 * columns
    np.testing.assert_allclose(sums.matrix, scaled.T @ columns, rtol=1e-5)
    np.testing.assert_allclose(sums.vector, scaled.T @ target, rtol=1e-5)
    assert sums.energy == pytest.approx(float(root**2 @ target**2), rel=1e-5)
    reflected = rows.seen / (albedos.lightness[:, None] * albedos.color)
    np.testing.assert_allclose(sums.seen, scaled[:, :LOBES].T @ reflected, rtol=1e-5)
    np.testing.assert_allclose(sums.sent, scaled[:, :LOBES].T @ rows.sent, rtol=1e-5)
    assert sums.count == POOLS


def test_amounts_are_those_of_all_pools_and_priors_together() -> None:
    rows, albedos, weights, light = pools()
    columns, target, root = written_out(rows, albedos, weights)
    lobes = (root[:, None] * columns)[:, :LOBES]
    ridge = RIDGE * np.sum(lobes**2) / LOBES
    noise = np.sum((root * target) ** 2) * NOISE**2 / max(POOLS / ALIKE, 1.0)
    prior = np.sqrt(np.append(np.full(LOBES, ridge), noise / ALBEDO_SPREAD**2))
    expected, _ = nnls(
        np.concatenate([root[:, None] * columns, np.diag(prior)]),
        np.concatenate([root * target, np.zeros(LOBES), [prior[-1] * ASSUMED_ALBEDO]]),
    )
    sums = sums_of(rows, albedos, weights)
    found, lit = solve_amounts(sums)
    np.testing.assert_allclose(found, expected, atol=1e-4 * expected.max())
    np.testing.assert_array_equal(lit, found > 0)
    assert ALBEDO_RANGE[0] < found[-1] < ALBEDO_RANGE[1]
    np.testing.assert_allclose(found[:-1], light.amounts, atol=0.1 * light.amounts.max())
    for guess in (lit, ~lit):
        np.testing.assert_allclose(solve_amounts(sums, lit=guess)[0], found, rtol=1e-9, atol=1e-12)


def test_a_light_that_is_held_stays_what_it_was() -> None:
    rows, albedos, weights, light = pools()
    sums = sums_of(rows, albedos, weights)
    other = np.roll(light.amounts, 1)
    shape = solve_amounts(sums, other / other.sum(), hold=1e5)[0][:-1]
    np.testing.assert_allclose(shape / shape.sum(), other / other.sum(), atol=1e-3)


@pytest.mark.parametrize("pull", [None, 0.0, 25.0])
def test_colours_are_found(pull: float | None) -> None:
    """Of a light of one colour, however they are drawn to one."""
    rows, albedos, weights, light = pools()
    found = with_colors(sums_of(rows, albedos, weights), light.amounts, light.mean_albedo, pull)
    np.testing.assert_allclose(found.colors, light.colors, atol=0.05 * light.colors.max())
    np.testing.assert_allclose(rows.shading(found), rows.columns @ found.colors + 0.4 * rows.sent, rtol=1e-5)
