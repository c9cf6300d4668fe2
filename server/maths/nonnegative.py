"""Light is not negative: the most probable SH function that is nowhere below zero.

Minimises (x - mean)^T H (x - mean) subject to B x >= 0, where the rows of B are the basis at directions all over the
sphere, by non-negative least squares on its dual (Lawson & Hanson 1974): exact in a finite number of steps, however
ill-conditioned H. What little remains below zero between those directions, and in colour channels, is taken by fading
the contrast.
"""

from __future__ import annotations

from functools import cache

import numpy as np
from numpy.typing import NDArray

from server.maths.sh import sh_basis, spherical_fibonacci

_PROBES = 1024
_MOST_STEPS = 300
_TOLERANCE = 1e-6
_LEAST_SCALE = 1e-14
_MEAN = 0.28209479177387814  # Y_00


@cache
def _basis(count: int, bands: int) -> NDArray[np.float64]:
    return sh_basis(spherical_fibonacci(count), bands)


def nonnegative_mean(mean: NDArray[np.float64], precision: NDArray[np.float64]) -> NDArray[np.float64]:
    """The x nearest to `mean` [n] in the metric of `precision` [n, n] whose function is not negative (to about 1 %)."""
    basis = _basis(_PROBES, round(len(mean) ** 0.5))
    least = float((basis @ mean).min())
    if least >= 0:
        return mean
    scales, axes = np.linalg.eigh(precision)
    roots = np.sqrt(np.maximum(scales, _LEAST_SCALE * scales[-1]))
    unwhiten = axes / roots  # x = unwhiten (start + responses force), force >= 0
    start, responses = roots * (axes.T @ mean), (basis @ unwhiten).T
    result, active, force = mean, np.empty(0, np.int64), np.empty(0)
    for _ in range(_MOST_STEPS):
        values = basis @ result
        worst = int(values.argmin())
        if values[worst] >= _TOLERANCE * least or worst in active:
            break
        active, force = _supported(responses, start, np.append(active, worst), np.append(force, 0.0))
        result = unwhiten @ (start + responses[:, active] @ force)
    return np.asarray(result)


def _supported(
    responses: NDArray[np.float64], start: NDArray[np.float64], active: NDArray[np.int64], force: NDArray[np.float64]
) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """The constraints in `active` with a positive multiplier, and their multipliers; `force`: a first guess, >= 0."""
    while len(active):
        solved = np.asarray(np.linalg.lstsq(responses[:, active], -start, rcond=None)[0], np.float64)
        pulls = solved <= 0
        if not pulls.any():
            return active, solved
        steps = np.where(pulls, force / np.maximum(force - solved, 1e-300), np.inf)
        first = int(steps.argmin())  # on the way to `solved` its force ends first
        force = np.delete(force + steps[first] * (solved - force), first)
        active = np.delete(active, first)
    return active, force


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
