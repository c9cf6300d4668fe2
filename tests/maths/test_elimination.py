"""Offsets of regions and surfaces are eliminated as by the covariance that they give observations."""

from __future__ import annotations

import numpy as np
import pytest

from server.light.shell.elimination import MANY_USED, Offsets, Regions
from server.light.shell.evidence import Evidence
from server.light.shell.patches import GRIDS

COLUMNS = 30
OF_REGION, OF_SURFACE = 0.3, 0.5
"""Variances of the offsets."""


def observed(random: np.random.Generator) -> Evidence:
    """A surface of one region, and others of several of one to four patches."""
    surfaces_of_regions = np.array([0, 1, 1, 1, 2, 3, 3, 4, 4, 4, 4])
    regions = np.repeat(np.arange(len(surfaces_of_regions)), random.integers(1, 5, len(surfaces_of_regions)))
    n = len(regions)
    nothing = np.zeros(n, np.bool_)
    surfaces = surfaces_of_regions[regions]
    return Evidence(np.zeros(n), np.zeros((n, 2)), np.ones(n), nothing, np.arange(n), regions, surfaces)


@pytest.mark.parametrize("used", [COLUMNS, COLUMNS // 2])
def test_normal_equations_are_those_of_all_observations_at_once(used: int) -> None:
    """Whether all columns tell something or half of them are 0."""
    assert (used > MANY_USED * COLUMNS) == (used == COLUMNS)
    random = np.random.default_rng(3)
    evidence = observed(random)
    n, counts = len(evidence.rows), random.uniform(1, 20, len(evidence.rows))
    design, residuals = random.uniform(0, 1, (n, COLUMNS)), random.normal(size=(n, 2))
    design[:, random.permutation(COLUMNS)[used:]] = 0.0
    regions = Regions.of(design.astype(np.float32), counts, evidence)
    surfaces = np.full(evidence.surfaces[-1] + 1, OF_SURFACE)
    offsets = Offsets.of(regions, OF_REGION, surfaces, np.zeros(len(surfaces)))
    matrix, vector = offsets.normal_equations(design.astype(np.float32), residuals)
    alike = [labels[:, None] == labels for labels in (evidence.regions, evidence.surfaces)]
    precision = np.linalg.inv(np.diag(1 / counts) + OF_REGION * alike[0] + OF_SURFACE * alike[1])
    np.testing.assert_allclose(matrix, design.T @ precision @ design / GRIDS, rtol=1e-4, atol=1e-4)
    np.testing.assert_allclose(vector, design.T @ precision @ residuals / GRIDS, rtol=1e-4, atol=1e-4)


def test_further_columns_add_to_them_what_all_columns_together_have() -> None:
    random = np.random.default_rng(5)
    evidence = observed(random)
    n, counts = len(evidence.rows), random.uniform(1, 20, len(evidence.rows))
    design = random.uniform(0, 1, (n, COLUMNS + 4)).astype(np.float32)
    residuals = random.normal(size=n)
    surfaces = np.full(evidence.surfaces[-1] + 1, OF_SURFACE)

    def offsets(columns: np.ndarray) -> Offsets:
        return Offsets.of(Regions.of(columns, counts, evidence), OF_REGION, surfaces, np.zeros(len(surfaces)))

    matrix, vector = offsets(design).normal_equations(design, residuals[:, None])
    few = design[:, :COLUMNS]
    across, own, slope = offsets(few).beside(few, residuals).blocks(design[:, COLUMNS:])
    np.testing.assert_allclose(across, matrix[:COLUMNS, COLUMNS:], rtol=1e-4, atol=1e-4)
    np.testing.assert_allclose(own, matrix[COLUMNS:, COLUMNS:], rtol=1e-4, atol=1e-4)
    np.testing.assert_allclose(slope, vector[COLUMNS:, 0], rtol=1e-4, atol=1e-4)
