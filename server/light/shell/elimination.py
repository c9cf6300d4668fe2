"""What regions and surfaces have of their own, eliminated exactly from the normal equations of the objective.

An observation of patch p is a row of the design times the unknowns, plus an offset of its surface, plus one of its
region within the surface. Offsets have Gaussian priors, and each concerns few patches, so the best ones are known in
closed form given all else. Of the sums over GRIDS grids, of patches and of priors of offsets, the mean counts.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_matrix

from server.light.shell.evidence import Evidence
from server.light.shell.patches import GRIDS

MANY_USED = 0.9
"""Up to this share of columns that are not 0 throughout, these are worth picking out."""

Floats = NDArray[np.float64]
Singles = NDArray[np.float32]
Ints = NDArray[np.int64]


@dataclass(frozen=True)
class Regions:
    """Weighted sums of the design's columns over the patches of each region."""

    counts: Floats
    """[n] weights of the patches: 1 / variance of their noise."""
    sizes: Ints
    """[regions] number of patches, which stand one region after the other."""
    members: csr_matrix
    """[regions, n] the weights of each one's patches."""
    totals: Floats
    """[regions] of weights."""
    sums: Singles
    """[regions, c] of columns."""
    surfaces: Ints
    """[regions] which surface each is part of."""

    @staticmethod
    def of(design: Singles, counts: Floats, evidence: Evidence) -> Regions:
        """Of the columns of `design` [n, c] with weights `counts` [n]."""
        starts = np.searchsorted(evidence.regions, np.arange(evidence.regions[-1] + 2))
        members = _members(counts, starts)
        totals = np.bincount(evidence.regions, counts).astype(np.float64)
        return Regions(counts, np.diff(starts), members, totals, members @ design, evidence.surfaces[starts[:-1]])

    def columns(self, count: int, weight: float) -> Regions:
        """The same for the first `count` columns, with weights `weight` times as great."""
        return Regions(
            weight * self.counts,
            self.sizes,
            self.members * np.float32(weight),
            weight * self.totals,
            np.float32(weight) * self.sums[:, :count],
            self.surfaces,
        )

    def sums_of(self, values: NDArray[np.floating]) -> NDArray[np.floating]:
        """[regions, ...] weighted sums of values [n, ...]."""
        return np.asarray(self.members @ values)


@dataclass(frozen=True)
class Offsets:
    """Priors of the offsets, and what they leave of sums over patches."""

    regions: Regions
    of_region: Floats | float
    """[regions] or one for all: variance of a region's."""
    keeps: Floats
    """[regions] share of a sum over a region that its own offset leaves."""
    center: Floats
    """[surfaces] prior mean of a surface's."""
    factor: Floats
    """[surfaces] variance of a surface's given all else."""

    @staticmethod
    def of(regions: Regions, of_region: Floats | float, of_surface: Floats | float, center: Floats) -> Offsets:
        """of_region, of_surface: variances; center: [surfaces]."""
        keeps = 1 / (1 + of_region * regions.totals)
        totals = np.bincount(regions.surfaces, keeps * regions.totals)
        return Offsets(regions, of_region, keeps, center, np.asarray(of_surface / (1 + of_surface * totals)))

    def normal_equations(self, design: Singles, residuals: Floats) -> tuple[Singles, Singles]:
        """[c, c] and [c, m]: matrix and vector of `design` [n, c] for residuals [n, m] from which `center` was taken,
        without the offsets.

        With the share a of a region's sums taken from each of its patches, products of what is left sum to
        sum_p w_p x_p y_p - (2 a - a^2 W) (sum_p w_p x_p) (sum_p w_p y_p), W the region's total of weights w_p.
        """
        sums = self.regions.sums
        used = np.flatnonzero(sums.any(axis=0))
        if len(used) > MANY_USED * sums.shape[1]:
            return self._equations(design, sums, residuals)
        matrix = np.zeros((sums.shape[1], sums.shape[1]), np.float32)
        vector = np.zeros((sums.shape[1], residuals.shape[1]), np.float32)
        matrix[np.ix_(used, used)], vector[used] = self._equations(design[:, used], sums[:, used], residuals)
        return matrix, vector

    def beside(self, design: Singles, residuals: Floats) -> Beside:
        """The normal equations of `design` [n, c] for residuals [n] from which `center` was taken, for more columns."""
        return Beside(self, self._left(design, self.regions.sums), self.left(residuals[:, None].astype(np.float32)))

    def _equations(self, design: Singles, sums: Singles, residuals: Floats) -> tuple[Singles, Singles]:
        """As of normal_equations. sums: [regions, c] those of `design`."""
        of_design = self._left(design, sums)
        return _product(of_design, of_design), _product(of_design, self.left(residuals.astype(np.float32)))

    def left(self, values: Singles) -> tuple[Singles, Singles]:
        """As of _left."""
        return self._left(values, self.regions.sums_of(values))

    def _left(self, values: Singles, sums: NDArray[Any]) -> tuple[Singles, Singles]:
        """[n, c] and [surfaces of several regions, c]: products of the first, less those of the second, are sums over
        patches without the offsets. sums: [regions, c] weighted ones of `values` [n, c]."""
        regions, several = self.regions, self._has_several
        left = np.repeat(-self._taken[:, None] * sums.astype(np.float32, copy=False), regions.sizes, axis=0)
        left += values
        left *= np.sqrt(regions.counts).astype(np.float32)[:, None]
        of_surfaces = self._sums(sums)[several].astype(np.float32, copy=False)
        of_surfaces *= np.sqrt(self.factor[several]).astype(np.float32)[:, None]
        return left, of_surfaces

    @cached_property
    def _taken(self) -> Singles:
        """[regions] share of a region's sums that is taken from each of its patches: the a whose 2 a - a^2 W is what
        offsets explain, the region's own and, of a surface with no other, the surface's too."""
        regions, keeps = self.regions, self.keeps
        alone = ~self._has_several[regions.surfaces]
        factor = self.of_region * keeps + np.where(alone, self.factor[regions.surfaces] * keeps**2, 0.0)
        return np.asarray(factor / (1 + np.sqrt(1 - regions.totals * factor)), np.float32)

    def of_surfaces(self, residuals: Floats) -> Floats:
        """[surfaces, ...] the best offsets of surfaces, for residuals [n, ...] from which `center` was taken."""
        sums = self._sums(self.regions.sums_of(residuals))
        return np.asarray((sums.T * self.factor + self.center).T)

    @cached_property
    def _has_several(self) -> NDArray[np.bool_]:
        """[surfaces] regions; of a single one both offsets are eliminated at once."""
        return np.asarray(np.bincount(self.regions.surfaces, minlength=len(self.factor)) > 1)

    @cached_property
    def _kept(self) -> csr_matrix:
        """[surfaces, regions] what is kept of each one's regions."""
        starts = np.searchsorted(self.regions.surfaces, np.arange(len(self.factor) + 1))
        return _members(self.keeps, starts)

    def _sums(self, by_region: NDArray[Any]) -> NDArray[Any]:
        """[surfaces, ...] of sums over regions [regions, ...]."""
        return np.asarray(self._kept @ by_region)


@dataclass(frozen=True)
class Beside:
    """Normal equations to which columns may be added. Offsets are eliminated."""

    offsets: Offsets
    of_design: tuple[Singles, Singles]
    of_residuals: tuple[Singles, Singles]
    """As of Offsets.left."""

    def blocks(self, columns: Singles) -> tuple[Singles, Singles, Singles]:
        """What `columns` [n, m] add: [c, m] beside the matrix, [m, m] and [m] below it and the vector."""
        of_columns = self.offsets.left(columns)
        across, own, vector = (_product(one, of_columns) for one in (self.of_design, of_columns, self.of_residuals))
        return across, own, vector[0]


def add_smoothness(matrix: Singles, pairs: Ints, strength: Floats | float) -> None:
    """Add the curvature of `strength` times the squared difference of the unknowns of pairs [n, 2], all distinct."""
    strength = np.broadcast_to(strength, len(pairs))
    matrix[np.diag_indices_from(matrix)] += np.bincount(pairs.ravel(), np.repeat(strength, 2), len(matrix))
    for first, second in (pairs.T, pairs.T[::-1]):
        matrix[first, second] -= strength


def _product(one: tuple[Singles, Singles], other: tuple[Singles, Singles]) -> Singles:
    """[c, m] of two of Offsets._left, with c and m columns."""
    result = one[0].T @ other[0]
    result -= one[1].T @ other[1]
    result /= np.float32(GRIDS)
    return np.asarray(result)


def _members(shares: Floats, starts: Ints) -> csr_matrix:
    """[groups, n] `shares` [n] of the members of groups that stand one after the other; starts: [groups + 1]."""
    return csr_matrix((shares.astype(np.float32), np.arange(len(shares)), starts), (len(starts) - 1, len(shares)))
