"""Procedural solid textures of linear albedo from 0.05 to 0.8, smooth enough not to alias."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

Values = NDArray[np.floating]
Texture = Callable[[Values], Values]
"""[n, 3] world points to [n, 3] linear albedo."""

PLAIN_ALBEDO = 0.5
"""Albedo of scenes without textures."""


def painted(red: float, green: float, blue: float) -> Texture:
    """Paint of one colour, slightly mottled."""
    color = np.array([red, green, blue])

    def texture(points: Values) -> Values:
        x, y, z = (points * 60).T
        mottle = np.sin(x + 2 * np.sin(0.7 * y)) * np.sin(1.3 * y + 0.5 * z) * np.sin(0.9 * z + 1.1 * x)
        mottled: Values = color * (1 + 0.1 * mottle[:, None])
        return mottled

    return texture


def wood(points: Values) -> Values:
    """Rings along x."""
    x, y, z = points.T
    ring = np.sin(110 * (z + 0.05 * np.sin(5 * x) + 0.7 * y) + 3 * np.sin(2.3 * x))
    knot = np.sin(9 * x + 2 * np.sin(13 * z))
    shade = (0.75 + 0.18 * ring + 0.07 * knot)[:, None]
    rings: Values = shade * np.array([0.66, 0.43, 0.25])
    return rings


def cloth(points: Values) -> Values:
    """A woven check pattern."""
    x, y, z = points.T
    weave = np.sin(55 * x) * np.sin(55 * y + 0.5) + np.sin(55 * z) * np.sin(55 * y + 0.5)
    stripe = np.tanh(3 * np.sin(21 * x))
    check: Values = (0.7 + 0.1 * weave + 0.15 * stripe)[:, None] * np.array([0.3, 0.4, 0.55])
    return check


def wallpaper(points: Values) -> Values:
    """Stripes on the walls, boards on the floor, a light ceiling."""
    x, y, z = points.T
    pattern = np.tanh(2 * np.sin(14 * x + 14 * z)) * (0.7 + 0.3 * np.sin(11 * y))
    walls = (0.9 + 0.1 * pattern)[:, None] * np.array([0.68, 0.64, 0.55])
    boards = (0.8 + 0.12 * np.tanh(4 * np.sin(38 * x)) + 0.08 * np.sin(5 * z + 9 * np.sin(3 * x)))[:, None]
    floor = boards * np.array([0.5, 0.36, 0.24])
    ceiling = np.array([0.74, 0.74, 0.72])
    return np.where((y < 1e-6)[:, None], floor, np.where((y > 2.6 - 1e-6)[:, None], ceiling, walls))
