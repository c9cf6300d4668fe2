"""The places whose light one client is told: the middle of its view, the places it asked for, the virtual objects."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from server.frame_context import FrameContext
from server.light.light_message import LightPlaces
from server.light.place_light import LitPlace, Place
from server.light.room_light import RoomLight
from server.light.view_middle import view_middle

MOST_OBJECTS = 64
"""Objects with a light of their own, which costs 0.3 ms and 1 kB each in every frame; the others have `Light.sh`."""

Floats = NDArray[np.float64]


class ToldPlaces:
    """Kept between frames: a still view of unchanged light is not looked up again."""

    def __init__(self) -> None:
        self.newest = LightPlaces()
        """World axes of the room, metres; where the camera is lost, those of the last frame that was placed."""
        self._known_by: tuple[Floats, ...] = ()

    def update(
        self,
        context: FrameContext,
        light: RoomLight,
        asked: Floats,
        objects: Mapping[str, Floats],
        *,
        is_still: bool,
    ) -> None:
        """Look up the light at all places. asked: [n, 3] world; objects: the middle of each by name.

        `is_still`: geometry and light are those of the frame before.
        """
        origin = context.volume.origin_world
        middle = view_middle(context.engine, context.surface, context.volume_from_camera)
        view = (context.volume_from_camera[:3, 3] if middle is None else middle) + origin
        places = _places(view, asked, objects)
        positions = np.array([place.position for place in places])
        known_by = positions, light.estimate().sh
        if is_still and _are_equal(known_by, self._known_by):
            return
        found = light.arriving_at(context.engine, context.volume, positions)
        self.newest = LightPlaces(view, [LitPlace(*pair) for pair in zip(places, found, strict=True)])
        self._known_by = known_by


def _places(view: Floats, asked: Floats, objects: Mapping[str, Floats]) -> list[Place]:
    lit = list(objects.items())[:MOST_OBJECTS]
    return [
        Place("view", 0, view),
        *(Place("place", index, position) for index, position in enumerate(asked)),
        *(Place("object", index, position, name) for index, (name, position) in enumerate(lit)),
    ]


def _are_equal(some: Sequence[Floats], others: Sequence[Floats]) -> bool:
    return len(some) == len(others) and all(np.array_equal(*pair) for pair in zip(some, others, strict=True))
