"""B9 (thesis 8.3): bases for distant light, of which spherical harmonics are one, alike in all that is asked of them.

Haar wavelets stand on the equal-area octahedral map (Clarberg 2008), where they are orthonormal on the sphere as they
are in the square; sums of cells of a finer or coarser map span what wavelets would, had the map no power of two.
Spherical Gaussians (Wang et al. 2009) stand on a Fibonacci lattice, one width for all. Nothing is tuned: the prior
follows from that of spherical harmonics, read as one of functions on the sphere, the width from the lattice.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from math import cos, expm1, log, pi, sqrt

import numpy as np
from numpy.typing import NDArray

from server.maths.nonnegative_qp import solve_nonnegative
from server.maths.sh import band_of, sh_basis, spherical_fibonacci

Floats = NDArray[np.float64]

FINE_BANDS = 16
"""Bands in which functions of all bases are compared: the finest cells are 30 degrees wide, 16 bands tell 12 apart."""
SIZES = (4, 9, 16, 25, 36)
"""Numbers of coefficients: squares of spherical harmonics' bands, so that all bases can cost the same."""
_FINE_SIDE = 240  # of the map that cells are integrated on: whole multiples of 2 to 6 and of 16 cells
_FINEST_SIDE = 16


@dataclass(frozen=True, eq=False)
class Basis:
    """Functions B_j on the sphere; a light is the sum of c_j B_j. Equal only to itself."""

    name: str
    values: Callable[[Floats], Floats]
    """Unit directions [..., 3] -> [..., size]."""
    sh: Floats
    """[size, FINE_BANDS^2] integral of B_j Y_i."""
    gram: Floats
    """[size, size] integral of B_j B_k."""
    from_amounts: Floats | None
    """[size, size] coefficients of amounts that are not negative where the light is not: heights of cells, weights of
    lobes; None where there are no such amounts."""

    @property
    def size(self) -> int:
        """Number of coefficients."""
        return len(self.gram)

    def precision(self) -> Floats:
        """[size, size] prior precision of the coefficients, as 1 + l (l + 1) is that of spherical harmonics'.

        That prior is one of functions: harmonics up to FINE_BANDS of variance 1 / (1 + l (l + 1)), for which a
        function's energy is the integral of its square and its gradient's. The coefficients are those of the nearest
        function of the basis, G^-1 R y, so their covariance is G^-1 R S R^T G^-1.
        """
        nearest = np.linalg.solve(self.gram, self.sh)
        precision = np.linalg.inv((nearest * prior_variance()) @ nearest.T)
        return np.asarray((precision + precision.T) / 2)

    def nearest(self, directions: Floats, flux: Floats, *, nonnegative: bool = False) -> Floats:
        """[size, channels] of the light nearest in the mean square to `flux` [n, channels] from `directions` [n, 3].

        nonnegative: of those that are nowhere negative (amounts). Raises ValueError where the basis has no amounts.
        """
        moments = self.values(directions).T @ flux
        if not nonnegative:
            return np.asarray(np.linalg.solve(self.gram, moments))
        if self.from_amounts is None:
            raise ValueError(f"{self.name} have no amounts that could be kept from being negative")
        matrix, vectors = self.from_amounts.T @ self.gram @ self.from_amounts, self.from_amounts.T @ moments
        amounts = [solve_nonnegative(matrix, vectors[:, c])[0] for c in range(flux.shape[1])]
        return np.asarray(self.from_amounts @ np.stack(amounts, axis=1))

    def open_transfer(self, normals: Floats) -> Floats:
        """[..., size] 1/pi integral of B_j max(n.w, 0) over the sphere, for unit `normals` [..., 3]."""
        per_band = lambert_bands()[band_of(FINE_BANDS**2)]
        kept = np.flatnonzero(per_band)
        return np.asarray((sh_basis(normals, FINE_BANDS)[..., kept] * per_band[kept]) @ self.sh[:, kept].T)


def prior_variance() -> Floats:
    """[FINE_BANDS^2] of the harmonics of a light, relative (server.light.light_estimation.prior_precision)."""
    band = band_of(FINE_BANDS**2)
    return np.asarray(1 / (1.0 + band * (band + 1.0)))


@cache
def lambert_bands() -> Floats:
    """[FINE_BANDS] of the clamped cosine over pi (Ramamoorthi and Hanrahan 2001, eq. 8), by quadrature of its half."""
    nodes, weights = np.polynomial.legendre.leggauss(FINE_BANDS)
    cosine, half = (nodes + 1) / 2, weights / 2
    legendre = np.polynomial.legendre.legvander(cosine, FINE_BANDS - 1)
    bands = 2 * (half * cosine) @ legendre
    return np.asarray(np.where(np.abs(bands) < 1e-12, 0.0, bands))


def harmonics(size: int) -> Basis:
    """Spherical harmonics. Raises ValueError unless `size` is a square."""
    bands = round(sqrt(size))
    if bands * bands != size:
        raise ValueError(f"{size} coefficients are no whole number of bands")
    return Basis("SH", lambda d: sh_basis(d, bands), np.eye(size, FINE_BANDS**2), np.eye(size), None)


def gaussians(size: int, sharpness: float | None = None) -> Basis:
    """Spherical Gaussians a exp(s (axis . d - 1)), axes on a Fibonacci lattice, a such that their sum is 1 on average.

    Sharpness None: see `meeting_sharpness`. Without a bound on amounts, the prior's lights would be nearest to sums of
    Gaussians as flat as can be, which span spherical harmonics: there would be nothing to compare.
    """
    s = meeting_sharpness(size) if sharpness is None else sharpness
    axes, height = spherical_fibonacci(size), 4 * pi / size / gaussian_integral(s)

    def values(directions: Floats) -> Floats:
        return np.asarray(height * np.exp(s * (directions @ axes.T - 1)))

    gram = height**2 * gaussian_overlap(s, axes @ axes.T)
    return Basis("SG", values, height * _gaussian_sh(size, s), gram, np.eye(size))


def gaussian_integral(sharpness: float) -> float:
    """Of exp(s (axis . d - 1)) over the sphere: 2 pi (1 - exp(-2 s)) / s."""
    return 2 * pi * -expm1(-2 * sharpness) / sharpness


def gaussian_overlap(sharpness: float, cosines: Floats) -> Floats:
    """Integral of the product of two Gaussians whose axes are apart by angles with `cosines`: one of sharpness |m|,
    m = s (axis + axis'), times what it is less high: 4 pi exp(-2 s) sinh |m| / |m|."""
    m = np.maximum(sharpness * np.sqrt(np.maximum(2 + 2 * cosines, 0.0)), 1e-9)
    return np.asarray(2 * pi * np.exp(m - 2 * sharpness) * -np.expm1(-2 * m) / m)


def meeting_sharpness(size: int) -> float:
    """With which neighbours of a lattice of so many meet at half their height, so that their sum is nearly even.

    On a hexagonal lattice of cells of 4 pi / size, neighbours are apart by the root of 2 / sqrt(3) times that.
    """
    apart = sqrt(8 * pi / sqrt(3) / size)
    return log(2) / (1 - cos(apart / 2))


def _gaussian_sh(size: int, sharpness: float) -> Floats:
    """[size, FINE_BANDS^2] of Gaussians of height 1: zonal, so by Funk and Hecke's theorem a factor a band."""
    nodes, weights = np.polynomial.legendre.leggauss(200)
    legendre = np.polynomial.legendre.legvander(nodes, FINE_BANDS - 1)
    per_band = 2 * pi * (weights * np.exp(sharpness * (nodes - 1))) @ legendre
    return np.asarray(sh_basis(spherical_fibonacci(size), FINE_BANDS) * per_band[band_of(FINE_BANDS**2)])


def cells(size: int) -> Basis:
    """Light that is even in each cell of an octahedral map of sqrt(size) x sqrt(size) cells; orthonormal."""
    return _of_cells("cells", np.eye(size))


def haar(size: int) -> Basis:
    """Haar wavelets on the octahedral map. Raises ValueError unless `size` is a power of 4."""
    side = round(sqrt(size))
    if side * side != size or side & (side - 1):
        raise ValueError(f"{size} coefficients are no whole number of levels of Haar wavelets: 4, 16, 64")
    return _of_cells("Haar", haar_matrix(side))


def largest_haar(size: int, directions: Floats, flux: Floats) -> Basis:
    """Of all wavelets on 16 x 16 cells the `size` that hold most of one light (Ng et al. 2003).

    For light that is known before its transfer is. flux: [n, channels] from unit `directions` [n, 3].
    """
    finest = haar(_FINEST_SIDE**2)
    held = np.sum((finest.values(directions).T @ flux) ** 2, axis=1)
    return _of_cells("Haar, largest", haar_matrix(_FINEST_SIDE)[np.sort(np.argsort(-held)[:size])])


@cache
def haar_matrix(side: int) -> Floats:
    """[side^2, side^2] orthonormal rows: the square's mean, then three wavelets for each square, coarse ones first."""
    if side == 1:
        return np.ones((1, 1))
    half = side // 2
    coarse = np.kron(haar_matrix(half).reshape(-1, half, half), np.full((1, 2, 2), 0.5))
    signs = np.array([[[1, -1], [1, -1]], [[1, 1], [-1, -1]], [[1, -1], [-1, 1]]]) / 2
    place = np.eye(half * half).reshape(-1, half, half)
    fine = np.concatenate([np.kron(place, sign[None]) for sign in signs])
    return np.concatenate([coarse, fine]).reshape(side * side, -1)


def _of_cells(name: str, matrix: Floats) -> Basis:
    """Functions of heights in cells: orthonormal rows of `matrix` [n, cells] over the root of a cell's area."""
    size, count = matrix.shape
    side, root = round(sqrt(count)), sqrt(4 * pi / count)
    if side * side != count:
        raise ValueError(f"{count} cells are no square")

    def values(directions: Floats) -> Floats:
        column, row = np.minimum((octahedral(directions) + 1) / 2 * side, side - 1).astype(int).T
        return np.asarray(matrix.T[(row * side + column).T] / root)

    return Basis(name, values, matrix @ _cell_sh(side) / root, np.eye(size), matrix if size == count else None)


@cache
def _cell_sh(side: int) -> Floats:
    """[side^2, FINE_BANDS^2] integrals of the harmonics over the cells."""
    steps = (np.arange(_FINE_SIDE) + 0.5) * 2 / _FINE_SIDE - 1
    result = np.zeros((side * side, FINE_BANDS**2))
    for row, v in enumerate(steps):
        fine = sh_basis(from_octahedral(np.stack([steps, np.full(_FINE_SIDE, v)], -1)), FINE_BANDS)
        first = row * side // _FINE_SIDE * side
        result[first : first + side] += fine.reshape(side, -1, FINE_BANDS**2).sum(1)
    return result * (4 * pi / _FINE_SIDE**2)


def octahedral(directions: Floats) -> Floats:
    """Unit directions [..., 3] -> [..., 2] in [-1, 1]^2: the equal-area map, z > 0 inside |u| + |v| < 1."""
    x, y, z = np.moveaxis(directions, -1, 0)
    radius = np.sqrt(np.maximum(1 - np.abs(z), 0.0))
    v = radius * np.arctan2(np.abs(y), np.abs(x)) * (2 / pi)
    u = radius - v
    u, v = np.where(z < 0, 1 - v, u), np.where(z < 0, 1 - u, v)
    return np.stack([np.copysign(u, x), np.copysign(v, y)], -1)


def from_octahedral(points: Floats) -> Floats:
    """The inverse of `octahedral`: [..., 2] -> unit directions [..., 3]."""
    u, v = np.moveaxis(np.abs(points), -1, 0)
    inside = 1 - u - v
    radius = 1 - np.abs(inside)
    azimuth = ((v - u) / np.maximum(radius, 1e-300) + 1) * (pi / 4)
    level = radius * np.sqrt(2 - radius**2)
    x, y = level * np.cos(azimuth), level * np.sin(azimuth)
    z = np.copysign(1 - radius**2, inside)
    return np.stack([np.copysign(x, points[..., 0]), np.copysign(y, points[..., 1]), z], -1)


@cache
def bases_of(size: int) -> tuple[Basis, ...]:
    """All that exist with so many coefficients: wavelets where the map is a power of two, else its cells."""
    is_level = size in (4, 16)
    return harmonics(size), gaussians(size), haar(size) if is_level else cells(size)
