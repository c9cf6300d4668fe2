"""Samples of a room's surfaces, and point emitters among them: what is searched for in near_light.py."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from server.maths.robust_squares import Blocks, Floats

Shares = Callable[[Floats], NDArray[np.floating]]
"""Emitters [n, 3] to what each sample sees of them, g [n, samples]."""

_BLOCK_M = 0.5
_NEAREST_M = 1e-3


@dataclass(frozen=True)
class Scene:
    """Samples, and what they see of the light from outside."""

    positions: Floats
    """[n, 3] metres."""
    normals: Floats
    """[n, 3] unit."""
    values: Floats
    """[n, 3] what is seen over the albedo, linear RGB."""
    outside: Floats
    """[n, columns] B: what white would show of each source outside."""


@dataclass(frozen=True)
class Emitter:
    """A light inside the room."""

    position: Floats
    """[3] metres, in the space of the samples."""
    intensity: Floats
    """[3] radiant intensity, linear RGB: radiance times m^2."""
    position_covariance: Floats
    """[3, 3] m^2."""
    intensity_std: Floats
    """[3] one standard deviation."""
    gain: float
    """Share of the variance left over at unseen places that it explains."""
    share: float
    """Of the light (luminance) that the samples receive."""


def blocks_of(positions: Floats, normals: Floats) -> Blocks:
    """[n] number of the place that a sample belongs to: a cell of half a metre, and the way that its surface faces."""
    cells = np.floor(positions / _BLOCK_M).astype(np.int64)
    axis = np.abs(normals).argmax(axis=1)
    side = np.take_along_axis(normals, axis[:, None], axis=1)[:, 0] > 0
    _, numbers = np.unique(np.column_stack([cells, 2 * axis + side]), axis=0, return_inverse=True)
    return np.asarray(numbers.ravel(), np.int64)


def share_slopes(positions: Floats, normals: Floats, emitter: Floats) -> Floats:
    """[n, 3] derivative of the unshadowed g by the emitter's position [3]."""
    away = emitter - positions
    distance = np.maximum(np.linalg.norm(away, axis=1, keepdims=True), _NEAREST_M)
    facing = (away * normals).sum(axis=1, keepdims=True)
    return np.asarray((normals / distance**3 - 3 * facing * away / distance**5) / np.pi)
