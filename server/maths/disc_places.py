"""Sample positions in a disc light, for blocker search and for rays. Counts as in shadow_map.cl."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

SEARCHED = 6
RINGS = (4, 8, 12)
"""Number of parts on each ring of a disc."""
RAYS, RAY_SETS = 8, 16
"""Rays per sample, and number of ray sets that neighbouring samples alternate between."""

Floats = NDArray[np.float64]


def search_places() -> Floats:
    """[SEARCHED, 2] on the unit ring."""
    angle = 2 * np.pi * (np.arange(SEARCHED) + 0.25) / SEARCHED
    return np.stack([np.cos(angle), np.sin(angle)], axis=1)


def disc_places() -> Floats:
    """[parts, 2] in the unit disc, one for each part of equal area; point-symmetric."""
    upto = np.cumsum([0, *RINGS]) / sum(RINGS)
    rings = []
    for count, begin, end, first in zip(RINGS, upto[:-1], upto[1:], (0.2, 0.6, 0.1), strict=True):
        angle = 2 * np.pi * (np.arange(count) + first) / count
        rings.append(np.sqrt((begin + end) / 2) * np.stack([np.cos(angle), np.sin(angle)], axis=1))
    return np.concatenate(rings)


def ray_places() -> Floats:
    """[RAY_SETS * RAYS, 2] in the unit disc, set by set; each set, and all together, form a spiral."""
    index = np.arange(RAYS * RAY_SETS)
    turn, radius = np.pi * (3 - np.sqrt(5)) * index, np.sqrt((index + 0.5) / len(index))
    spiral = np.stack([radius * np.cos(turn), radius * np.sin(turn)], axis=1)
    scattered = index[:RAY_SETS] * 7 % RAY_SETS  # sets of neighbouring samples are apart on the spiral
    places: Floats = spiral[(RAY_SETS * index[:RAYS] + scattered[:, None]).ravel()]
    return places
