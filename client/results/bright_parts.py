"""Splits a lat-long picture of light into its bright parts, as lights from one direction each, and the rest.

A part is a connected area of pixels that are much brighter than the whole, or, where none are, those above half of the
greatest brightness: programs that do not read the picture then still have a light. Its light above that brightness
becomes one directional light; the picture keeps what is below, so that both together are the light that arrives.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from server.light.panorama import panorama_directions

BRIGHT = 4.0
"""Threshold of bright parts, in mean luminances of the sphere. A lamp or window has 10 to 1000, a lit white wall 2."""
LEAST_BRIGHT = 1.2
"""If nothing is as bright, in mean luminances, light is the same from everywhere and there is no bright part."""
MOST_LIGHTS = 8
"""Most bright parts: engines draw a shadow map for each."""
LEAST_SHARE = 0.02
"""Least share of the irradiance of all bright parts together: weaker parts stay in the picture."""
_REC709 = np.array([0.2126, 0.7152, 0.0722])

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class BrightPart:
    """Light from one direction."""

    direction: tuple[float, float, float]
    """Unit, towards the light, in the picture's axes: +y up, the middle column along -z, +x to the right of it."""
    irradiance: tuple[float, float, float]
    """Of a surface that faces it, in units of radiance times steradian: white shows 1 / pi of it."""


def split(radiance: Floats) -> tuple[list[BrightPart], Floats]:
    """(bright parts, strongest first; the rest [h, w, 3]) of a lat-long picture [h, w, 3], linear and not negative."""
    height, width = radiance.shape[:2]
    solid = solid_angles(height, width)
    towards = panorama_directions(height, width).reshape(height, width, 3)
    luminance = radiance @ _REC709
    mean = float((luminance * solid).sum() / solid.sum())
    limit = max(LEAST_BRIGHT * mean, min(BRIGHT * mean, float(luminance.max()) / 2))
    share = np.where(luminance > limit, 1 - limit / np.maximum(luminance, 1e-30), 0.0)[..., None]
    excess = radiance * share
    found = []
    for number, area in _areas(share[..., 0] > 0):
        irradiance = (excess * solid[..., None])[area].sum(axis=0)
        middle = (towards[area] * ((excess @ _REC709) * solid)[area][:, None]).sum(axis=0)
        length = float(np.linalg.norm(middle))
        if length > 0:
            part = BrightPart(_three(middle / length), _three(irradiance))
            found.append((float(irradiance @ _REC709), number, area, part))
    found.sort(key=lambda item: (-item[0], item[1]))
    least = LEAST_SHARE * sum(item[0] for item in found)
    kept = [item for item in found[:MOST_LIGHTS] if item[0] >= least]
    rest = radiance.copy()
    for _, _, area, _ in kept:
        rest[area] -= excess[area]
    return [part for *_, part in kept], rest


def solid_angles(height: int, width: int) -> Floats:
    """[h, w] steradian of each pixel; their sum is 4 pi."""
    edges = np.cos(np.linspace(0, math.pi, height + 1))
    return np.repeat(((edges[:-1] - edges[1:]) * 2 * math.pi / width)[:, None], width, axis=1)


def _areas(bright: NDArray[np.bool_]) -> list[tuple[int, NDArray[np.bool_]]]:
    """(number, mask) of the connected areas; the picture's left and right edge are neighbours."""
    count, labels = cv2.connectedComponents(bright.astype(np.uint8), connectivity=8)
    for left, right in zip(labels[:, 0], labels[:, -1], strict=True):
        if left and right and left != right:
            labels[labels == right] = left
    return [(number, labels == number) for number in range(1, count) if (labels == number).any()]


def _three(values: Floats) -> tuple[float, float, float]:
    return float(values[0]), float(values[1]), float(values[2])
