"""Lights of exactly 16 coefficients that are nowhere negative: smooth lobes over an even sky."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from tests.reference.sh import sh_basis, sphere_rule
from tests.scenes.analytic import Floats

_RULE = sphere_rule(12, 24)


def uniform(radiance: ArrayLike = (1.0, 1.0, 1.0), bands: int = 4) -> Floats:
    """[bands^2, 3] the same radiance from everywhere."""
    sh = np.zeros((bands * bands, 3))
    sh[0] = np.sqrt(4 * np.pi) * np.asarray(radiance)
    return sh


def lobe(direction: ArrayLike, color: ArrayLike = (1.0, 1.0, 1.0)) -> Floats:
    """[16, 3] radiance ((1 + cos) / 2)^3 around `direction`: 0 opposite to it, 1 in it."""
    points, weights = _RULE
    toward = np.asarray(direction, float) / np.linalg.norm(direction)
    values = ((1 + points @ toward) / 2) ** 3
    return np.outer((weights * values) @ sh_basis(points, 4), color)


def lobe_and_sky(direction: ArrayLike, sky: float = 0.1, color: ArrayLike = (1.0, 0.9, 0.7)) -> Floats:
    """[16, 3] a coloured lobe over an even sky: its dominant direction is the lobe's."""
    return lobe(direction, color) + uniform(sky * np.array([0.8, 0.9, 1.0]))


def unit(vectors: ArrayLike) -> Floats:
    """Vectors [..., 3] of length 1."""
    vectors = np.asarray(vectors, float)
    return vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)


def random_directions(count: int, seed: int) -> Floats:
    """[count, 3] evenly random."""
    return unit(np.random.default_rng(seed).normal(size=(count, 3)))


def degrees_between(a: ArrayLike, b: ArrayLike) -> float:
    """Angle between two directions."""
    return float(np.degrees(np.arccos(np.clip(unit(a) @ unit(b), -1, 1))))
