"""Whether the estimator's standard deviations are honest: how often the truth lies within its 95 % interval (B5)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tests.bench.light.environment import best_scale

Floats = NDArray[np.float64]

QUANTILE_95 = 1.96
"""Of the normal distribution, both sides."""


@dataclass(frozen=True)
class Estimate:
    """One scene's light, its standard deviation (infinite where it is not known) and the truth, [n, 3] each."""

    mean: Floats
    std: Floats
    true: Floats


def coverage(estimates: Sequence[Estimate]) -> Floats:
    """[n] share of scenes and colours whose true coefficient lies inside its interval, for each coefficient.

    The scale of a light is not known, so the truth is brought to the estimate's by one factor. A coefficient whose
    deviation is not known has no interval and does not count; NaN where none has.
    """
    known = np.array([np.isfinite(item.std) for item in estimates])
    inside = np.array([is_inside(item) for item in estimates]) & known
    count = known.sum(axis=(0, 2))
    return np.asarray(np.where(count > 0, inside.sum(axis=(0, 2)) / np.maximum(count, 1), np.nan))


def is_inside(item: Estimate) -> NDArray[np.bool_]:
    """[n, 3] whether the true coefficient lies inside its interval; always where the deviation is infinite."""
    apart = np.abs(item.mean - best_scale(item.true, item.mean) * item.true)
    return np.asarray(apart <= QUANTILE_95 * item.std)
