"""Places from which virtual objects see the light of a room: each its own, as long as they are few.

Light from a ceiling 2 m away is not distant: between two objects a metre apart its level differs by tens of percent.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

MOST_PLACES = 8
"""More objects share places: for each, the radiance along all directions of the visibility tests is kept, 0.25 to 1 MB
of device memory."""

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class LightPlaces:
    """Where the light is looked up for objects."""

    positions: Floats
    """[places, 3] metres."""
    owners: tuple[int, ...] = ()
    """[objects] the place of each object; none where there is one place for all."""


EVERYWHERE = LightPlaces(np.zeros((1, 3)))
"""For a light that is the same at all places."""


def places_of(middles: Floats) -> LightPlaces:
    """Places for objects with `middles` [objects, 3]; at least one object.

    The middles themselves if they are at most MOST_PLACES, else those of which each next one is farthest from all
    before it (Gonzalez 1985: no object is more than twice as far from its place as with the best places).
    """
    chosen, distances = [0], np.linalg.norm(middles - middles[0], axis=1)
    while len(chosen) < MOST_PLACES and distances.max() > 0:
        chosen.append(int(distances.argmax()))
        distances = np.minimum(distances, np.linalg.norm(middles - middles[chosen[-1]], axis=1))
    positions = middles[np.sort(chosen)]
    apart = np.linalg.norm(middles[:, None] - positions, axis=2)
    return LightPlaces(positions, tuple(int(place) for place in apart.argmin(axis=1)))
