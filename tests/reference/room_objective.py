"""Float64 twin of server/light/shell/objective.py: equations (1) and (2) and their sums, written term by term."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from server.light.shell import weights as constants
from server.light.shell.patches import GRIDS
from server.light.shell.shell import neighbours

Floats = NDArray[np.float64]


def level_objective(
    z: Floats,
    materials: Floats,
    offsets: Floats,
    shares: Floats,
    known: Floats,
    level: Floats,
    material_weights: Floats,
    surfaces: NDArray[np.int64],
    regions: NDArray[np.int64],
    prior: Floats,
    deviation: Floats,
    middle: float,
) -> float:
    """Half the sum that is minimised, for a room without saturated cells, clipped patches and outliers.

    z [k] log radiance of cells; materials [g] logits of albedo; offsets [f] of log albedo; shares [n, k], known [n],
    level [n], material_weights [n, g], surfaces [n], regions [n]; prior, deviation [k] of z; middle: logit
    of albedo about which materials lie.
    """
    total = 0.0  # of all grids
    logit = material_weights @ materials
    residual = level - np.log(shares @ np.exp(z) + known) - np.log(1 / (1 + np.exp(-logit))) - offsets[surfaces]
    precision = 1 / constants.PATCH_NOISE**2
    for region in np.unique(regions):
        own = residual[regions == region]
        weight = 1 / constants.REGION_SPREAD**2
        offset = precision * own.sum() / (precision * len(own) + weight)  # the best d_r
        total += precision * ((own - offset) ** 2).sum() / 2 + weight * offset**2 / 2
    edge = np.where(offsets < 0, constants.DARK_EDGE, constants.BRIGHT_EDGE)
    total += ((edge / constants.SURFACE_SPREAD) ** 2 * (np.sqrt(1 + (offsets / edge) ** 2) - 1)).sum()
    total /= GRIDS
    total += (((z - prior) / deviation) ** 2).sum() / 2
    for first, second in neighbours():
        ratio = (z[first] - z[second]) / constants.EDGE
        total += constants.SMOOTHNESS * constants.EDGE**2 * (np.sqrt(1 + ratio**2) - 1)
    total += (((materials - middle) / constants.ALBEDO_SPREAD) ** 2).sum() / 2
    return float(total)


def middle_objective(middle: float, first: float, albedos: Floats, chroma: Floats) -> float:
    """Half the two terms that m follows from, for materials that go along with it from where it was `first`.

    albedos: [n] logarithms of the patches' as they were then, chroma [n, 2]; those of the brightest white surface go
    along.
    """
    logits = np.log([constants.MEAN_ALBEDO / (1 - constants.MEAN_ALBEDO)])
    off = np.linalg.norm(chroma - constants.WHITE_CHROMA, axis=1) / constants.WHITE_TOLERANCE
    counts = np.exp(-(off**2) / 2) + constants.NOT_WHITE
    ordered = np.argsort(albedos)
    ranks = np.array([(counts[ordered[:i]].sum() + counts[ordered[i]] / 2) / counts.sum() for i in range(len(counts))])
    brightest = np.interp(np.linspace(0.91, 0.99, 9), ranks, albedos[ordered]).mean()
    grown = brightest + (middle - first) / (1 + np.exp(first))
    total = ((middle - logits[0]) / constants.MEAN_SPREAD) ** 2
    total += ((grown - np.log(constants.BRIGHTEST)) / constants.BRIGHTEST_SPREAD) ** 2
    return float(total) / 2


def chroma_objective(
    chroma: Floats,
    parts: Floats,
    seen: Floats,
    surfaces: NDArray[np.int64],
    regions: NDArray[np.int64],
    brightest: NDArray[np.bool_],
) -> float:
    """Half the sum over equation (2), at the best t, a_f and c_r.

    chroma [k, 2] of sources; parts [n, k] T; seen [n, 2] less what known surface brings; surfaces [n], regions [n];
    brightest [n]: patches of the brightest surface.
    """
    residual = seen - parts @ chroma
    total = sum(_of_surface(residual[surfaces == f], regions[surfaces == f]) for f in np.unique(surfaces)) / GRIDS
    red, blue = constants.TINT_AXIS
    pull, weight = 1 / constants.CELL_CHROMA**2, 1 / np.array([constants.TINT, constants.TINT_ACROSS]) ** 2
    turned = chroma @ np.array([[red, blue], [blue, -red]])  # along the colours of black bodies, and across
    tint = pull * turned.sum(axis=0) / (pull * len(chroma) + weight)
    total += pull * ((turned - tint) ** 2).sum() + (weight * tint**2).sum()
    for first, second in neighbours():
        total += constants.CHROMA_SMOOTHNESS * ((chroma[first] - chroma[second]) ** 2).sum()
    white = residual[brightest].mean(axis=0) - constants.WHITE_CHROMA
    return float(total + (white**2).sum() / constants.WHITE_CHROMA_SPREAD**2) / 2


def _of_surface(residual: Floats, regions: NDArray[np.int64]) -> float:
    """The least sum over one surface's patches, over its own chroma and its regions'; residual [n, 2]."""
    precision, own = 1 / constants.CHROMA_NOISE**2, np.zeros(2)
    numbers, members = np.unique(regions, return_inverse=True)
    besides, counts = np.zeros((len(numbers), 2)), np.bincount(members)[:, None]
    sums = np.stack([np.bincount(members, column) for column in residual.T], axis=1)
    for _ in range(60):  # Cauchy's penalty as a Gaussian's of the width that the last offsets have
        variance = constants.REGION_CHROMA**2 + (besides**2).sum(axis=1, keepdims=True)
        keeps = precision / (1 + precision * counts * variance)
        own = (keeps * sums).sum(axis=0) / ((keeps * counts).sum() + 1 / constants.SURFACE_CHROMA**2)
        besides = variance * keeps * (sums - counts * own)
    total = precision * ((residual - own - besides[members]) ** 2).sum() + (own**2).sum() / constants.SURFACE_CHROMA**2
    return float(total + np.log1p((besides**2).sum(axis=1) / constants.REGION_CHROMA**2).sum())
