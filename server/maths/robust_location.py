"""Robust location of many noisy values, of which up to half may be outliers."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

TUKEY = 4.685
"""Cutoff of Tukey's biweight in scales (Beaton and Tukey 1974): 95 % efficiency for normal errors."""
HEAP = 0.3
"""Share of the weight in the shortest interval. Half, as usual, could not separate two equal clusters."""
HEAP_OF_NORMAL = 0.7706
"""Width, in standard deviations, of the shortest interval with that share of a normal distribution."""
_ROUNDS = 8


@dataclass(frozen=True)
class Location:
    """Robust location of a set of values."""

    value: float
    std: float
    """Standard deviation of `value`; errors that a group shares count once."""
    scale: float
    """Standard deviation of one value of weight 1 around it."""
    share: float
    """Share of the weight within two scales."""


def shortest_part(values: Floats, weights: Floats, share: float) -> tuple[float, float]:
    """Middle and width of the shortest interval with `share` of the weight; half: the shorth (Andrews et al. 1972)."""
    order = np.argsort(values, kind="stable")
    ordered, reached = values[order], np.cumsum(weights[order])
    before = reached - weights[order]
    last = np.searchsorted(reached, before + share * reached[-1], side="left")
    first = np.flatnonzero(last < len(ordered))
    widths = ordered[last[first]] - ordered[first]
    best = int(first[np.argmin(widths)])
    low, high = float(ordered[best]), float(ordered[last[best]])
    return 0.5 * (low + high), high - low


def robust_location(
    values: Floats, weights: Floats, groups: NDArray[np.int64], near: float, least_scale: float
) -> Location:
    """Location of `values` [n] with `weights` [n] > 0, reweighted by Tukey's biweight.

    If the values form several clusters, the one at `near` is used if it has at least half the weight of the largest.
    `groups` [n]: numbers from 0; values of a group share their errors. The scale is at least `least_scale`.
    """
    middle, width = shortest_part(values, weights, HEAP)
    scale = max(width / HEAP_OF_NORMAL, least_scale)

    def weight_near(place: float) -> float:
        return float(weights[np.abs(values - place) < 2 * scale].sum())

    value = near if weight_near(near) >= 0.5 * weight_near(middle) else middle
    for _ in range(_ROUNDS):
        u = (values - value) / (TUKEY * scale)
        kept = weights * np.square(np.clip(1 - u * u, 0, None))
        moved = float(kept @ (values - value)) / max(float(kept.sum()), 1e-300)
        value += moved
        if abs(moved) < 1e-3 * scale:
            break
    u = (values - value) / (TUKEY * scale)
    inside = np.abs(u) < 1
    push = np.where(inside, weights * (values - value) * np.square(1 - u * u), 0)
    slope = float(np.where(inside, weights * (1 - u * u) * (1 - 5 * u * u), 0).sum())
    scatter = float(np.square(np.bincount(groups, push)).sum())
    std = np.sqrt(scatter) / slope if slope > 0 else np.inf
    return Location(value, float(std), scale, weight_near(value) / float(weights.sum()))
