"""Discs of the light that virtual objects touch.

A saturated speck of the table that an object stands on is such a disc: seen from the object's middle it is a wide light
from below, though the object covers it, and shadow maps cannot be drawn from there.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from server.maths.direct_lights import DirectLight, SplitLight
from server.objects.rasterize import Placed


def without_touched(split: SplitLight, objects: Sequence[Placed]) -> SplitLight:
    """`split` without the discs whose middle is in an object's box.

    A disc is whole from one radius off the box on, and in between in proportion, so that none appears at once.
    """
    shares = [min([1.0, *(_distance_in_radii(disc, thing) for thing in objects)]) for disc in split.discs]
    shared = zip(split.discs, shares, strict=True)
    discs = (replace(disc, irradiance=share * disc.irradiance) for disc, share in shared if share > 0.0)
    return replace(split, discs=tuple(discs))


def _distance_in_radii(disc: DirectLight, placed: Placed) -> float:
    """Of the disc's middle from the object's box; infinite if it is distant."""
    if disc.center_m is None:
        return np.inf
    thing, volume_from_model = placed
    axes = volume_from_model[:3, :3]
    scales = np.linalg.norm(axes, axis=0)
    center = np.linalg.solve(axes, disc.center_m - volume_from_model[:3, 3])
    low, high = thing.bounds
    beside = np.maximum(np.maximum(low - center, center - high), 0.0) * scales
    return float(np.linalg.norm(beside)) / (disc.distance_m * float(np.tan(disc.half_angle_rad)))
