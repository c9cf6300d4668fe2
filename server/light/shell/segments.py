"""Patches of one surface: neighbours that face the same way and look alike, so that paint's edges part surfaces."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from server.light.shell.patches import key_numbers

LEVEL_EDGE = 0.7
"""If the mean logarithms of neighbouring patches differ by more than this, paint has an edge there, and not shading:
over the 15 cm between them, light falls to half only beside a lamp or in the rim of a shadow."""
CHROMA_EDGE = 0.2
"""The same for each coordinate of log chroma."""
_OFFSETS = np.stack(np.meshgrid(*[np.arange(-1, 2)] * 3, indexing="ij"), -1).reshape(-1, 3)[14:]
"""[13, 3] to one of each two opposite neighbours in a grid."""

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]


def segments(keys: Ints, colors: Floats) -> Ints:
    """[n] from 0: which surface each patch is part of.

    keys: [n, 7] as in Patches, all different; colors: [n, 3] mean logarithm and chroma.
    """
    number = key_numbers(keys)
    order = np.argsort(number)
    keys, number = keys[order], number[order]
    first, second = [], []
    for offset in np.pad(_OFFSETS, ((0, 0), (0, keys.shape[1] - 3))):
        wanted = key_numbers(keys + offset)
        place = np.minimum(np.searchsorted(number, wanted), len(keys) - 1)
        found = number[place] == wanted
        first.append(order[found])
        second.append(order[place[found]])
    one, other = np.concatenate(first), np.concatenate(second)
    apart = np.abs(colors[one] - colors[other])
    is_alike = (apart[:, 0] < LEVEL_EDGE) & (apart[:, 1:].max(axis=1) < CHROMA_EDGE)
    return _components(len(keys), one[is_alike], other[is_alike])


def _components(count: int, one: Ints, other: Ints) -> Ints:
    """[count] from 0: which part of the graph of edges (one, other) each node is in."""
    label = np.arange(count)
    while True:
        least = np.minimum(label[one], label[other])
        new = label.copy()
        np.minimum.at(new, one, least)
        np.minimum.at(new, other, least)
        new = new[new]
        if np.array_equal(new, label):
            return np.unique(label, return_inverse=True)[1].ravel()
        label = new
