"""Weight of earlier frames' information relative to a new frame's (generalises the moving average of thesis 5.4).

Directional forgetting: along each direction of the unknowns, a new frame replaces as much information as it brings, and
nothing is forgotten along directions about which it has no information.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from server.maths.bayes import NormalEquations

_NOTHING = 1e-9  # share of the largest information below which it is rounding error

Floats = NDArray[np.float64]


def remembered(known: NormalEquations, frame: NormalEquations, memory: float) -> NormalEquations:
    """What is left of `known` beside `frame`; `memory`: its share where the frame brings as much as it replaces.

    In the basis in which both matrices are diagonal, k and f = 1 - k, what is left is max(memory k, k - f): frames that
    are alike decay by `memory`, as of old. The solution of `known` stays what it was; its residual decays by `memory`.
    """
    root, inverse = _roots(known.matrix + frame.matrix)
    values, turned = np.linalg.eigh(inverse @ known.matrix @ inverse)
    shares = np.clip(values, 0.0, 1.0)
    there = shares > _NOTHING
    kept = np.where(there, np.maximum(memory, 1.0 - (1.0 - shares) / np.where(there, shares, 1.0)), 0.0)
    along = turned.T @ (inverse @ known.vector)
    explained = np.where(there, 1.0 / np.where(there, shares, 1.0), 0.0)[:, None] * along**2
    residual = np.maximum(known.energy - explained.sum(axis=0), 0.0)
    back = root @ turned
    return NormalEquations(
        (back * (kept * shares)) @ back.T,
        back @ (kept[:, None] * along),
        memory * residual + (kept[:, None] * explained).sum(axis=0),
        memory * known.count,
    )


def _roots(matrix: Floats) -> tuple[Floats, Floats]:
    """Symmetric square root of a positive semidefinite matrix, and its pseudo-inverse."""
    values, vectors = np.linalg.eigh(matrix)
    values = np.maximum(values, 0.0)
    there = values > 1e-13 * max(float(values[-1]), 1e-300)
    roots = np.sqrt(values)
    inverse = np.where(there, 1.0 / np.where(there, roots, 1.0), 0.0)
    return (vectors * roots) @ vectors.T, (vectors * inverse) @ vectors.T
