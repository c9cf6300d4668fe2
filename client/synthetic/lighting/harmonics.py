"""Real orthonormal spherical harmonics of four bands, without Condon-Shortley phase, index l(l+1)+m."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

COEFFICIENTS = 16
LAMBERT = np.repeat((1.0, 2 / 3, 1 / 4, 0.0), (1, 3, 5, 7))
"""[16] clamped-cosine factors over pi: a uniform sky of radiance 1 gives white a radiance of 1."""


def basis(directions: NDArray[np.floating]) -> NDArray[np.floating]:
    """[n, 16] values at unit `directions` [n, 3], in the same precision."""
    x, y, z = directions.T
    xx, yy, zz = x * x, y * y, z * z
    return np.stack(
        [
            np.full_like(x, 0.28209479177387814),
            0.4886025119029199 * y,
            0.4886025119029199 * z,
            0.4886025119029199 * x,
            1.0925484305920792 * x * y,
            1.0925484305920792 * y * z,
            0.31539156525252005 * (3 * zz - 1),
            1.0925484305920792 * x * z,
            0.5462742152960396 * (xx - yy),
            0.5900435899266435 * y * (3 * xx - yy),
            2.890611442640554 * x * y * z,
            0.4570457994644658 * y * (5 * zz - 1),
            0.3731763325901154 * z * (5 * zz - 3),
            0.4570457994644658 * x * (5 * zz - 1),
            1.445305721320277 * z * (xx - yy),
            0.5900435899266435 * x * (xx - 3 * yy),
        ],
        axis=1,
    )


def unshadowed_transfer(normals: NDArray[np.floating]) -> NDArray[np.floating]:
    """[n, 16] exact Lambert transfer, including 1/pi, of surfaces with an open hemisphere."""
    return basis(normals) * LAMBERT.astype(normals.dtype)


def sphere_directions(count: int) -> NDArray[np.float64]:
    """[count, 3] unit directions of equal solid angle 4 pi / count (Fibonacci lattice)."""
    i = np.arange(count) + 0.5
    y = 1 - 2 * i / count
    azimuth = np.pi * (1 + 5**0.5) * i
    radius = np.sqrt(1 - y * y)
    return np.stack([radius * np.cos(azimuth), y, radius * np.sin(azimuth)], axis=1)
