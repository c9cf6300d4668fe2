"""Spherical harmonics with their derivatives: each is a homogeneous polynomial of the degree of its band."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import numpy as np
from numpy.typing import NDArray

from server.maths.sh import band_of, sh_basis, spherical_fibonacci

Floats = NDArray[np.float64]


def sh_with_slope(points: Floats, bands: int) -> tuple[Floats, Floats]:
    """The polynomials [k, bands^2] at `points` [k, 3] and their gradients [k, bands^2, 3].

    On unit points the polynomials are `sh_basis`; elsewhere they are r^l times it.
    """
    polynomials = _polynomials(bands)
    powers = np.ones((bands, 3, len(points)))
    for degree in range(1, bands):
        powers[degree] = powers[degree - 1] * points.T
    x, y, z = (powers[polynomials.degrees[axis], axis] for axis in range(3))  # [monomials, k] each
    values = (polynomials.factors @ (x * y * z)).reshape(4, bands * bands, len(points))
    return values[0].T, values[1:].transpose(2, 1, 0)


@dataclass(frozen=True)
class _Polynomials:
    """The polynomials of all bands."""

    degrees: NDArray[np.int64]
    """[3, monomials] powers of x, y, z."""
    factors: Floats
    """[4 bands^2, monomials]: of the polynomials, of their derivatives by x, by y, by z."""


@cache
def _polynomials(bands: int) -> _Polynomials:
    """Fitted to `sh_basis`: on the sphere the monomials of one degree are independent."""
    degrees = np.array([(a, b, l - a - b) for l in range(bands) for a in range(l + 1) for b in range(l + 1 - a)]).T
    points = spherical_fibonacci(8 * bands * bands)
    monomials = np.prod(points.T[:, None] ** degrees[..., None], axis=0)  # [monomials, points]
    basis, band = sh_basis(points, bands), band_of(bands * bands)
    factors = np.zeros((bands * bands, degrees.shape[1]))
    for l in range(bands):
        mine = degrees.sum(axis=0) == l
        solved = np.linalg.lstsq(monomials[mine].T, basis[:, band == l], rcond=None)[0]
        factors[np.ix_(band == l, mine)] = solved.T
    return _Polynomials(degrees, np.concatenate([factors, *(_derived(degrees, factors, axis) for axis in range(3))]))


def _derived(degrees: NDArray[np.int64], factors: Floats, axis: int) -> Floats:
    """The factors of the derivatives along one axis, by the same monomials."""
    number = {tuple(powers): k for k, powers in enumerate(degrees.T.tolist())}
    derived = np.zeros_like(factors)
    for k, powers in enumerate(degrees.T.tolist()):
        if powers[axis]:
            lower = [power - (i == axis) for i, power in enumerate(powers)]
            derived[:, number[tuple(lower)]] += powers[axis] * factors[:, k]
    return derived
