"""Weights that keep one large plane from deciding everything (thesis 5.2, eq. 5.7)."""

from __future__ import annotations

from typing import Literal

import numpy as np
from numpy.typing import NDArray

from server.maths.sh import spherical_fibonacci

Floats = NDArray[np.float64]
NormalWeights = Literal["none", "even", "printed"]

BINS = 64
GREATEST = 4.0
"""No pool counts more than this many times, or less than its inverse."""


def normal_weights(normals: Floats, weights: Floats, which: NormalWeights) -> Floats:
    """[n] factors for samples with unit `normals` [n, 3] and `weights` [n], from how they fill BINS even bins.

    The thesis states three effects: a large plane counts less, small surfaces count more, an even distribution of
    normals changes nothing. U / Q_e has them ("even"; here its root, within bounds: full inversion lets a few samples
    at edges decide); eq. 5.7 as printed, Q_e / U, does the opposite of the first two ("printed").
    """
    if which == "none" or not len(normals):
        return np.ones(len(normals))
    member = (normals @ spherical_fibonacci(BINS).T).argmax(axis=1)
    mass = np.bincount(member, weights, BINS)
    crowding = mass[member] / (mass.sum() / BINS)
    factor = crowding if which == "printed" else np.clip(crowding, 1e-9, None) ** -0.5
    return np.asarray(np.clip(factor, 1 / GREATEST, GREATEST))
