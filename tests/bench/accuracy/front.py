"""Which points of a sweep are worth choosing, and how sure their figures are."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from statistics import mean, median
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np

if TYPE_CHECKING:
    from tests.bench.accuracy.points import MeasuredPoint

T = TypeVar("T")
Statistic = Callable[..., Any]
"""Of an array, along `axis`."""

RESAMPLES = 2000
CONFIDENCE = 0.95


def front_of(points: Iterable[T], cost: Callable[[T], float], error: Callable[[T], float]) -> list[T]:
    """The Pareto front, cheapest first: points that no other beats in one of the two without being worse in the other.

    Points alike in both stay together; those whose cost or error is not finite are left out.
    """
    known = [point for point in points if np.isfinite(cost(point)) and np.isfinite(error(point))]
    front: list[T] = []
    for point in sorted(known, key=lambda p: (cost(p), error(p))):
        last = front[-1] if front else None
        if last is None or error(point) < error(last) or (cost(point), error(point)) == (cost(last), error(last)):
            front.append(point)
    return front


def interval(values: Sequence[float], *, of: Statistic = np.mean, seed: int = 0) -> tuple[float, float]:
    """Percentile bootstrap of the mean, or `of` another statistic: between which figures it lies with CONFIDENCE.

    Frames count as independent. Both are the value itself where there is only one. Raises ValueError for none.
    """
    if not values:
        raise ValueError("no values, so no interval")
    data = np.asarray(values, np.float64)
    chosen = np.random.default_rng(seed).integers(0, len(data), (RESAMPLES, len(data)))
    low, high = np.quantile(of(data[chosen], axis=1), ((1 - CONFIDENCE) / 2, (1 + CONFIDENCE) / 2))
    return float(low), float(high)


def light_error(point: MeasuredPoint) -> float:
    """Mean angle over the frames, degrees."""
    return mean(point.direction_deg) if point.direction_deg else np.nan


def picture_error(point: MeasuredPoint) -> float:
    """Mean FLIP over the frames; NaN where there is none."""
    return mean(point.flip) if point.flip else np.nan


def wall_ms(point: MeasuredPoint) -> float:
    """Median of whole frames."""
    return median(point.ms["total"])


def paced_ms(point: MeasuredPoint, cores: int) -> float:
    """Median time of processor over the cores, which other programs disturb little; of the wall where `cores` is 0."""
    return median(point.cpu_ms) / cores if cores else wall_ms(point)
