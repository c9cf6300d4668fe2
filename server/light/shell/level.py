"""The level of a room's light: the brightest white surface is as bright as white paint.

Scaling all light up and all albedo down changes next to nothing of what pictures show. So m, about which the materials
of objective.py lie, goes to where its own two terms balance: that of b, the log albedo of the brightest white surface,
and that of m itself.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from server.light.shell import weights
from server.light.shell.elimination import Offsets
from server.light.shell.evidence import Evidence

LOGIT = float(np.log(weights.MEAN_ALBEDO / (1 - weights.MEAN_ALBEDO)))
BRIGHTEST_RANKS = np.linspace(0.91, 0.99, 9)
"""Ranks of the patches, as shares of all, that are the brightest surface: without outliers, and with many patches, so
that what they show in the mean changes steadily."""
TRIAL = 0.1
"""Change of m by which it is tried how far the brightest white surface goes along."""

Floats = NDArray[np.float64]
Singles = NDArray[np.float32]


@dataclass(frozen=True)
class Paint:
    """The albedos of n patches before a step, and after it."""

    materials: Floats
    """[n, albedos] B of equation (1)."""
    logits: Floats
    """[albedos] m_g."""
    design: Singles
    """[n, k + albedos] derivatives of what patches show, sources first."""
    residual: Floats
    """[n] of (1), less the prior means of the surfaces' offsets."""
    surfaces: Offsets
    evidence: Evidence

    def offsets(self, change: Floats) -> Floats:
        """[n] the best ones of their surfaces after the `change` [k + albedos]."""
        offsets = self.surfaces.of_surfaces(self.residual - self.design @ change.astype(np.float32))
        return np.asarray(offsets[self.evidence.surfaces])

    def albedos(self, change: Floats) -> Floats:
        """[n] logarithms."""
        logits = self.logits + change[-len(self.logits) :]
        return np.asarray(np.log(logistic(self.materials @ logits)) + self.offsets(change))


def level_step(m: float, paint: Paint, change: Floats, along: Floats, chroma: Floats) -> float:
    """The whole Newton step of `m`, to where its own two terms balance; 0 where all is clipped.

    The rest of the objective lets the albedos go along with m in part only, and the brightest white surface less still.
    change: [k + albedos] of the Gauss-Newton step; along: [k + albedos] what all goes along by, for a change of 1;
    chroma: [n, 2] of albedo.
    """
    is_usable = ~paint.evidence.is_clipped
    if not is_usable.any():
        return 0.0
    now, then = (
        _brightest_white(paint.albedos(after)[is_usable], chroma[is_usable])
        for after in (change, change + TRIAL * along)
    )
    slope = 1 - logistic(m)  # of a log albedo by its logit
    pull = slope * (np.log(weights.BRIGHTEST) - now) / weights.BRIGHTEST_SPREAD**2
    pull += (LOGIT - m) / weights.MEAN_SPREAD**2
    gain = max(then - now, 0.0) / TRIAL
    return float(pull / (slope * gain / weights.BRIGHTEST_SPREAD**2 + 1 / weights.MEAN_SPREAD**2))


def _brightest_white(albedos: Floats, chroma: Floats) -> float:
    """Mean of the log albedos [n] between BRIGHTEST_RANKS of patches that count as their chroma [n, 2] is like white's.

    Others count a little: where nothing is white, the brightest are taken.
    """
    off = ((chroma - weights.WHITE_CHROMA) ** 2).sum(axis=1)
    counts = np.exp(-off / (2 * weights.WHITE_TOLERANCE**2)) + weights.NOT_WHITE
    order = np.argsort(albedos, kind="stable")
    ranks = (np.cumsum(counts[order]) - counts[order] / 2) / counts.sum()
    return float(np.interp(BRIGHTEST_RANKS, ranks, albedos[order]).mean())


def brightest(albedos: Floats, is_usable: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """[n] patches of the brightest surface, of those that are usable, by logarithms of albedo [n]."""
    if not is_usable.any():
        return is_usable
    least, most = np.quantile(albedos[is_usable], BRIGHTEST_RANKS[[0, -1]])
    return np.asarray(is_usable & (albedos >= least) & (albedos <= most))


def logistic(logit: Any) -> Any:
    """Albedo of a logit: the function s of the objective."""
    return 1 / (1 + np.exp(-logit))
