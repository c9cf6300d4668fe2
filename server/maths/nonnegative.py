"""Light is not negative: the most probable SH function that is nowhere below zero.

Minimises (x - mean)^T H (x - mean) subject to B x >= 0, where the rows of B are the basis at directions all over the
sphere, through its dual (projected gradients, Nesterov's momentum, restart: O'Donoghue & Candes 2015). What little
remains below zero between those directions, and in colour channels, is taken by fading the contrast.
"""

from __future__ import annotations

from functools import cache

import numpy as np
from numpy.typing import NDArray

from server.maths.sh import sh_basis, spherical_fibonacci

_CONSTRAINTS = 162
_PROBES = 1024
_STEPS = 400
_TOLERANCE = 1e-6
_MEAN = 0.28209479177387814  # Y_00


@cache
def _basis(count: int, bands: int) -> NDArray[np.float64]:
    return sh_basis(spherical_fibonacci(count), bands)


def nonnegative_mean(mean: NDArray[np.float64], precision: NDArray[np.float64]) -> NDArray[np.float64]:
    """The x nearest to `mean` [n] in the metric of `precision` [n, n] whose function is not negative (to about 1 %)."""
    basis = _basis(_CONSTRAINTS, round(len(mean) ** 0.5))
    values = basis @ mean
    if values.min() >= 0:
        return mean
    reach = np.linalg.solve(precision, basis.T)
    gram = basis @ reach
    step = 1 / float(np.linalg.eigvalsh(gram)[-1])
    force = np.zeros(len(values))
    ahead, momentum = force, 1.0
    for _ in range(_STEPS):
        updated = np.maximum(ahead - step * (gram @ ahead + values), 0.0)
        if np.dot(ahead - updated, updated - force) > 0:
            momentum = 1.0
        if np.abs(updated - force).max() <= _TOLERANCE * np.abs(updated).max():
            break
        onward = (1 + np.sqrt(1 + 4 * momentum * momentum)) / 2
        ahead = updated + (momentum - 1) / onward * (updated - force)
        force, momentum = updated, onward
    return np.asarray(mean + reach @ force)


def nonnegative_sum(base: NDArray[np.float64], deviation: NDArray[np.float64]) -> NDArray[np.float64]:
    """RGB coefficients [n, 3] base + s deviation, faded, with the largest s <= 1 that leaves it negative nowhere.

    One s and one fading for all channels: they change how strong colours and contrasts are, not what hue they have.
    """
    basis = _basis(_PROBES, round(len(base) ** 0.5))
    light = faded(base)
    here, change = basis @ light, basis @ deviation
    limits = np.where(change < 0, np.maximum(here, 0.0) / np.maximum(-change, 1e-300), 1.0)
    return faded(light + float(np.clip(limits.min(), 0.0, 1.0)) * deviation)


def faded(coefficients: NDArray[np.float64]) -> NDArray[np.float64]:
    """RGB coefficients [n, 3], all bands but the mean scaled by the factor nearest to 1 that leaves nothing negative.

    Channels without a positive mean become zero.
    """
    light = np.where(coefficients[0] > 0, coefficients, 0.0)
    mean = light[0] * _MEAN
    least = (_basis(_PROBES, round(len(light) ** 0.5)) @ light).min(axis=0)
    contrast = min((m / (m - v) for m, v in zip(mean, least, strict=True) if v < 0), default=1.0)
    light[1:] *= contrast
    return light
