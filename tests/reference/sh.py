"""Spherical harmonics and the clamped cosine in float64, from scipy and the textbook instead of recurrences."""

from __future__ import annotations

from math import factorial, pi, sqrt

import numpy as np
from numpy.typing import NDArray
from scipy.special import sph_harm_y

Floats = NDArray[np.float64]


def sh_basis(directions: Floats, bands: int) -> Floats:
    """Real basis at unit `directions` [..., 3] -> [..., bands^2], index l(l+1)+m, without Condon-Shortley phase.

    scipy's complex Y_l^m carries the phase (-1)^m; the real functions are sqrt(2) (-1)^m times its real part for m > 0
    and times the imaginary part of Y_l^|m| for m < 0.
    """
    x, y, z = np.moveaxis(np.asarray(directions, np.float64), -1, 0)
    polar, azimuth = np.arctan2(np.hypot(x, y), z), np.arctan2(y, x)
    values = np.empty((*x.shape, bands * bands))
    for l in range(bands):
        values[..., l * (l + 1)] = sph_harm_y(l, 0, polar, azimuth).real
        for m in range(1, l + 1):
            turned = sqrt(2) * (-1) ** m * sph_harm_y(l, m, polar, azimuth)
            values[..., l * (l + 1) + m] = turned.real
            values[..., l * (l + 1) - m] = turned.imag
    return values


def lambert_bands(bands: int) -> Floats:
    """[bands] clamped cosine over pi (Ramamoorthi & Hanrahan 2001, eq. 8)."""

    def of_band(l: int) -> float:
        if l == 1:
            return 2 / 3
        if l % 2:
            return 0.0
        return 2 * (-1) ** (l // 2 - 1) / ((l + 2) * (l - 1)) * factorial(l) / (2**l * factorial(l // 2) ** 2)

    return np.array([of_band(l) for l in range(bands)])


def open_transfer(normals: Floats, bands: int) -> Floats:
    """[..., bands^2] transfer of an unoccluded white surface: A_l Y(n) / pi."""
    return sh_basis(normals, bands) * np.repeat(lambert_bands(bands), 2 * np.arange(bands) + 1)


def sphere_rule(polar: int, azimuths: int) -> tuple[Floats, Floats]:
    """Directions [n, 3] and weights [n] (sum 4 pi): Gauss-Legendre in z, trapezoidal in azimuth.

    Exact for polynomials of degree below 2 polar and below `azimuths`.
    """
    z, weight = np.polynomial.legendre.leggauss(polar)
    azimuth = 2 * pi * np.arange(azimuths) / azimuths
    radius = np.sqrt(1 - z * z)[:, None]
    x, y = radius * np.cos(azimuth), radius * np.sin(azimuth)
    directions = np.stack([x, y, np.broadcast_to(z[:, None], x.shape)], -1).reshape(-1, 3)
    return directions, np.repeat(weight * 2 * pi / azimuths, azimuths)
