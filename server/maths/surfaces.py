"""Surfaces and their albedos, told apart by what the light so far does not explain of the picture.

What a pool of surface reflects, its radiance over its shading, has a colour and a lightness. Colours are clustered; the
lightnesses of one colour are up to three materials, as of a chequered floor (a mixture of normal distributions of the
logarithm, their number by BIC). Light and albedos are then found in turn.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from server.maths.sh import LUMINANCE

Floats = NDArray[np.float64]
Indices = NDArray[np.int64]

COLOR_RADIUS = 0.5
"""Colours of one surface lie so near each other, as logarithms of red and blue over green."""
SURFACE_COLORS, LIGHT_COLORS = 0.5, 0.15
"""Deviations of surfaces' and of lights' colours from grey, as logarithms of ratios."""
LEAST_SPREAD = 0.04
"""Deviation of a material's lightness, relative, at least."""
LEAST_GAP = 0.5
"""Between lightnesses of materials of one colour (logarithm)."""
MOST_MATERIALS = 3
"""Of one colour."""
_LEAST_SHARE = 0.005  # of all weight, for a colour of its own
_ALIKE = 20.0  # pools that say what one says: neighbours err alike
_BINS = 96
_EM_STEPS, _SETTLED = 20, 1e-4
_DARKEST = 1e-4


@dataclass(frozen=True)
class Albedos:
    """What each pool's surface reflects."""

    lightness: Floats
    """[n] of luminance, relative to the weighted mean."""
    color: Floats
    """[n, 3] of luminance 1."""
    count: int
    """Materials told apart."""


def one_albedo(count: int) -> Albedos:
    """All `count` pools are of one grey."""
    return Albedos(np.ones(count), np.ones((count, 3)), 1)


class Surfaces:
    """The colours seen so far."""

    def __init__(self) -> None:
        self._colors = np.empty((0, 2))

    @property
    def colors(self) -> Floats:
        """[n, 2] their middles: logarithms of red and blue over green."""
        return self._colors

    @colors.setter
    def colors(self, colors: Floats) -> None:
        self._colors = colors

    def albedos(
        self, seen: Floats, shading: Floats, weights: Floats, *, materials: bool = True, one_color: bool = False
    ) -> Albedos:
        """Albedos of pools of radiance `seen` [n, 3] whose shading, if white, were `shading` [n, 3]; weights [n] > 0.

        `materials`: also by lightness; without it all of one colour are of one albedo. `one_color`: all are of one.
        """
        reflected = np.maximum(seen, _DARKEST) / np.maximum(shading, _DARKEST)
        colors = np.log(reflected[:, [0, 2]] / reflected[:, 1:2])
        if one_color:
            self._colors = np.average(colors, axis=0, weights=weights)[None]
        member = np.zeros(len(seen), np.int64) if one_color else self._cluster(colors, weights)
        log_lightness = np.log(np.maximum(seen @ LUMINANCE, _DARKEST) / np.maximum(shading @ LUMINANCE, _DARKEST))
        lightness, color, count = np.zeros(len(seen)), np.ones((len(seen), 3)), 0
        owns = [own for own in (member == number for number in range(len(self._colors))) if own.any()]
        groups = [(log_lightness[own], weights[own]) for own in owns]
        for own, levels in zip(owns, levels_of_each(groups, MOST_MATERIALS if materials else 1), strict=True):
            lightness[own] = levels[np.abs(log_lightness[own, None] - levels).argmin(axis=1)]
            mean = weights[own] @ reflected[own]
            color[own] = mean / (mean @ LUMINANCE)
            count += len(levels)
        lightness = np.exp(lightness)
        lightness /= np.average(lightness, weights=weights)
        if one_color:
            return Albedos(lightness, np.ones_like(color), count)
        colored = color * light_of_surfaces(color, weights @ shading, member)
        return Albedos(lightness, colored / (colored @ LUMINANCE)[:, None], count)

    def _cluster(self, colors: Floats, weights: Floats) -> Indices:
        """[n] cluster of each of `colors` [n, 2]; renews the centres."""
        centers = self._colors if len(self._colors) else np.average(colors, axis=0, weights=weights)[None]
        for _ in range(3):
            centers, apart = _with_far_ones(colors, weights, centers)
            member = apart.argmin(axis=0)
            sums = np.bincount(member, weights, len(centers))
            moved = np.stack([np.bincount(member, weights * c, len(centers)) for c in colors.T], axis=1)
            centers = np.where(sums[:, None] > 0, moved / np.maximum(sums, 1e-300)[:, None], centers)
        self._colors = centers
        return np.asarray(_apart(colors, centers).argmin(axis=0))


def light_of_surfaces(color: Floats, tint: Floats, member: Indices) -> Floats:
    """[3] by what surfaces' colours [n, 3] found under light of colour `tint` [3] have to be multiplied.

    Rooms' lights are nearly white and their surfaces are of any colour, on average grey: each surface, `member` [n],
    however large, says as much of the light's colour as its own may differ from grey.
    """
    _, first = np.unique(member, return_index=True)
    shown = np.log(color[first] * tint / (color[first, 1:2] * tint[1]))
    count = len(first)
    share = count / (count + (SURFACE_COLORS / LIGHT_COLORS) ** 2)
    return np.asarray(tint / tint[1] / np.exp(share * shown.mean(axis=0)))


def _apart(colors: Floats, centers: Floats) -> Floats:
    """[k, n] squared distances of `colors` [n, 2] from `centers` [k, 2]."""
    x, y = colors.T
    return np.stack([(x - u) ** 2 + (y - v) ** 2 for u, v in centers])


def _with_far_ones(colors: Floats, weights: Floats, centers: Floats) -> tuple[Floats, Floats]:
    """`centers` and, where enough colours are far from all of them, the densest of those in turn; `_apart` of all."""
    least, apart = _LEAST_SHARE * weights.sum(), _apart(colors, centers)
    while True:
        far = apart.min(axis=0) > COLOR_RADIUS**2
        if weights[far].sum() < least:
            return centers, apart
        some = np.flatnonzero(far)[:: max(1, int(far.sum()) // 64)]
        mass = (_apart(colors[far], colors[some]) < COLOR_RADIUS**2) @ weights[far]
        if mass.max() < least:
            return centers, apart
        densest = colors[some[int(mass.argmax())]][None]
        centers, apart = np.vstack([centers, densest]), np.vstack([apart, _apart(colors, densest)])


def lightness_levels(values: Floats, weights: Floats, most: int) -> Floats:
    """[k <= most] means of the mixture that explains `values` [n] (logarithms) best for its size."""
    return levels_of_each([(values, weights)], most)[0]


def levels_of_each(groups: Sequence[tuple[Floats, Floats]], most: int) -> list[Floats]:
    """`lightness_levels` of each group of values and weights; in one go, which takes much less time."""
    best = [np.array([np.average(values, weights=weights)]) for values, weights in groups]
    several = [i for i, (values, _) in enumerate(groups) if most > 1 and np.ptp(values) >= 2 * LEAST_SPREAD]
    if not several:
        return best
    at, mass = (np.stack(arrays) for arrays in zip(*(_histogram(*groups[i]) for i in several), strict=True))
    independent = np.array([max(len(groups[i][0]) / _ALIKE, 2.0) for i in several])
    best_score = np.full(len(several), -np.inf)
    fits = _mixtures(at, mass, most)
    for k, (means, likelihood) in enumerate(fits, 1):
        scores = independent * likelihood - k * np.log(independent)
        for row, i in enumerate(several):
            if k > 1 and np.diff(np.sort(means[row])).min() < LEAST_GAP:
                continue  # shading that is not understood yet does as much
            if scores[row] > best_score[row]:
                best[i], best_score[row] = means[row], scores[row]
    return best


def _histogram(values: Floats, weights: Floats) -> tuple[Floats, Floats]:
    """Bins' middles and shares of the weight, [_BINS] each."""
    counts, edges = np.histogram(values, _BINS, (values.min(), values.max()), weights=weights)
    return 0.5 * (edges[1:] + edges[:-1]), counts / counts.sum()


def _mixtures(at: Floats, mass: Floats, most: int) -> list[tuple[Floats, Floats]]:
    """Of 1 to `most` normal distributions of one spread, by EM: their means [g, k] in each group [g, bins], and the
    mean log likelihoods [g]. All at once: the numbers are few, the operations are what takes time."""
    groups, bins = at.shape
    middle = (mass * at).sum(axis=1)
    spread = np.sqrt((mass * (at - middle[:, None]) ** 2).sum(axis=1))
    counts = np.arange(1, most + 1)
    there = np.arange(most) < counts[:, None]  # [fits, k]
    places = (np.arange(most) + 0.5) / counts[:, None]
    means = np.stack([np.interp(places, np.cumsum(m), a) for a, m in zip(at, mass, strict=True)], axis=1)
    at, mass = (np.broadcast_to(a, (most, groups, bins)).reshape(-1, bins) for a in (at, mass))
    means = means.reshape(-1, most)
    shares = np.repeat(there / counts[:, None], groups, axis=0)
    there = np.repeat(there, groups, axis=0)
    spread = np.maximum(spread / counts[:, None], LEAST_SPREAD).ravel()
    powers = np.stack([np.ones_like(at), at, at * at], axis=2)
    density = np.empty(at.shape)
    for _ in range(_EM_STEPS):
        off = (at[:, None] - means[..., None]) / spread[:, None, None]
        parts = np.exp(-0.5 * off * off)
        parts *= (shares / spread[:, None])[..., None]
        density = parts.sum(axis=1) + 1e-300
        parts *= (mass / density)[:, None]
        moments = parts @ powers
        shares = np.where(there, moments[..., 0] + 1e-12, 0.0)
        moved = moments[..., 1] / np.maximum(shares, 1e-12)
        variance = (moments[..., 2] - moved * (2 * moments[..., 1] - moved * moments[..., 0])).sum(axis=1)
        narrowed = np.maximum(np.sqrt(np.maximum(variance, 0.0)), LEAST_SPREAD)
        settled = max(float(np.abs(moved - means)[there].max()), float(np.abs(narrowed - spread).max())) < _SETTLED
        means, spread = moved, narrowed
        if settled:
            break
    likelihood = (mass * np.log(density)).sum(axis=1).reshape(most, groups)
    by_fit = means.reshape(most, groups, most)
    return [(by_fit[k, :, : k + 1], likelihood[k]) for k in range(most)]
