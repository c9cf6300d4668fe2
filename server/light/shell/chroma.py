"""The chroma of the light, equation (2) of objective.py: linear, given how much each source brings.

A cast of the room and a cast of its light look alike. What tells them apart: along one surface, where light of two
colours mixes, the cast changes; and a room's brightest surface is nearly always white paint.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_factor, cho_solve

from server.light.shell import weights
from server.light.shell.elimination import Offsets, Regions, add_smoothness

Floats = NDArray[np.float64]
Singles = NDArray[np.float32]
Ints = NDArray[np.int64]


def solve_chroma(
    parts: Singles,
    seen: Floats,
    sent: Floats,
    regions: Regions,
    pairs: Ints,
    brightest: NDArray[np.bool_] | None,
    *,
    finds_albedos: bool,
) -> Floats:
    """[k, 2] chroma of the sources.

    parts: [n, k], T; seen: [n, 2], q less what known surface brings; sent: [n, 2] chroma that the sources sent at the
    last step; regions: of `parts` and perhaps more. brightest: [n] patches of the brightest surface, None where it is
    not known to be white. finds_albedos: surfaces have colours of their own.
    """
    regions = regions.columns(parts.shape[1], (weights.PATCH_NOISE / weights.CHROMA_NOISE) ** 2)
    offsets = _albedo_offsets(regions, seen - sent, finds_albedos=finds_albedos)
    matrix, vector = offsets.normal_equations(parts, seen)
    if brightest is not None and brightest.any():
        sees, weight = parts[brightest].mean(axis=0), np.float32(1 / weights.WHITE_CHROMA_SPREAD**2)
        matrix += weight * np.outer(sees, sees)
        vector += weight * np.outer(sees, seen[brightest].mean(axis=0) - weights.WHITE_CHROMA).astype(np.float32)
    add_smoothness(matrix, pairs, weights.CHROMA_SMOOTHNESS)
    matrix[np.diag_indices_from(matrix)] += 1 / weights.CELL_CHROMA**2
    axes = np.stack([weights.TINT_AXIS, weights.TINT_AXIS[::-1] * [1, -1]], axis=1)  # along black bodies, and across
    return np.asarray(_with_tints(matrix, vector @ axes, np.array([weights.TINT, weights.TINT_ACROSS])) @ axes.T)


def _with_tints(matrix: Singles, vector: Floats, spreads: Floats) -> Floats:
    """[k, 2] chroma u along two axes, where all of it lies about the light's own, t.

    t is eliminated: along the axes it lies about 0 with standard deviations `spreads` [2], and its best value leaves
    `matrix` less one number throughout, a change of rank 1 (the Sherman-Morrison formula).
    """
    pull = 1 / weights.CELL_CHROMA**2
    less = pull**2 / (len(matrix) * pull + 1 / spreads**2)
    right = np.column_stack([vector, np.ones(len(matrix))]).astype(np.float32)
    solved = cho_solve(cho_factor(matrix, check_finite=False), right, check_finite=False).astype(np.float64)
    alone, ones = solved[:, :2], solved[:, 2]
    return np.asarray(alone + np.outer(ones, less * alone.sum(axis=0) / (1 - less * ones.sum())))


def _albedo_offsets(regions: Regions, residuals: Floats, *, finds_albedos: bool) -> Offsets:
    """Chroma of albedo: a surface's, and a region's besides, of which Cauchy's distribution is the prior.

    residuals: [n, 2] at the last step. A region's prior is the Gaussian whose penalty grows as fast as Cauchy's at the
    offset that the region has there.
    """
    surface, region = weights.SURFACE_CHROMA**2, weights.REGION_CHROMA**2
    if not finds_albedos:
        surface = region = weights.ONE_ALBEDO**2
    center = np.zeros(regions.surfaces[-1] + 1)
    offsets = Offsets.of(regions, region, surface, center)
    if not finds_albedos:
        return offsets
    means = regions.sums_of(residuals) / np.maximum(regions.totals, 1e-9)[:, None]
    besides = means - offsets.of_surfaces(residuals)[regions.surfaces]
    return Offsets.of(regions, region + (besides**2).sum(axis=1), surface, center)
