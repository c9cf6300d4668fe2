"""The places whose light one client is told: the middle of its view, the places it asked for, the virtual objects."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from server.frame_context import FrameContext
from server.light.light_message import LightPlaces
from server.light.place_light import LitPlace, Place, PlaceLight
from server.light.room_light import RoomLight
from server.light.shell.room_model import SOLVE_EVERY
from server.light.shell.solution import LookUp
from server.light.view_middle import ViewMiddle

MOST_OBJECTS = 64
"""Objects with a light of their own, which costs 2 ms and 1 kB each where the light has changed; the others have
`Light.sh`."""

VIEW_STEP = 0.05
"""Share of its distance from the camera by which the middle of the view moves before the light is told of a new place:
a place costs 2 ms, and a camera that is held in hand moves by less from frame to frame."""

Floats = NDArray[np.float64]
Key = tuple[str, int, bytes]


class ToldPlaces:
    """Kept between frames: a place is looked up again where the light or the scan has changed."""

    def __init__(self) -> None:
        self.newest = LightPlaces()
        """World axes of the room, metres; where the camera is lost, those of the last frame that was placed."""
        self._middle: ViewMiddle | None = None
        self._view: Floats | None = None
        self._places: list[Place] = []
        self._begun: LookUp | None = None
        self._sh: Floats = np.zeros(0)
        self._frames = 0

    def begin(self, context: FrameContext) -> None:
        """Let the device find the middle of a frame's view."""
        self._middle = ViewMiddle(context.engine, context.surface)

    def look_up(self, context: FrameContext, light: RoomLight, asked: Floats, objects: Mapping[str, Floats]) -> None:
        """Find the places, wait for the middle of the view, and begin to trace what is met from new ones.

        asked: [n, 3] world; objects: the middle of each by name.
        """
        eye, origin = context.volume_from_camera[:3, 3], context.volume.origin_world
        middle = self._middle.seen_from(eye) if self._middle else None
        view = eye if middle is None else middle
        if self._view is None or np.linalg.norm(view + origin - self._view) > VIEW_STEP * np.linalg.norm(view - eye):
            self._view = view + origin
        self._places = _places(self._view, asked, objects)
        told = {_key(lit.place) for lit in self.newest.lit}
        new = [place.position for place in self._places if _key(place) not in told]
        self._begun = light.look_up(context, np.array(new)) if new else None

    def update(self, context: FrameContext, light: RoomLight, *, is_still: bool) -> None:
        """Look up the light at all places. `is_still`: the geometry is that of the frame before."""
        kept = self._kept(light, is_still=is_still)
        new = [place for place in self._places if _key(place) not in kept]
        if new:
            positions = np.array([place.position for place in new])
            found = light.arriving_at(context.engine, context.volume, positions, self._begun)
            kept |= {_key(place): one for place, one in zip(new, found, strict=True)}
        self._begun = None
        self.newest = LightPlaces(self._view, [LitPlace(place, kept[_key(place)]) for place in self._places])

    def _kept(self, light: RoomLight, *, is_still: bool) -> dict[Key, PlaceLight]:
        """What was found under the same light and still holds: in a still view, and between solutions of the model."""
        sh = light.estimate().sh
        is_same, self._sh = np.array_equal(sh, self._sh), sh
        self._frames = self._frames if is_still else self._frames + 1
        if is_same and (is_still or (light.has_model and self._frames < SOLVE_EVERY)):
            return {_key(lit.place): lit.light for lit in self.newest.lit}
        self._frames = 0
        return {}


def _key(place: Place) -> Key:
    return place.of, place.index, place.position.tobytes()


def _places(view: Floats, asked: Floats, objects: Mapping[str, Floats]) -> list[Place]:
    lit = list(objects.items())[:MOST_OBJECTS]
    return [
        Place("view", 0, view),
        *(Place("place", index, position) for index, position in enumerate(asked)),
        *(Place("object", index, position, name) for index, (name, position) in enumerate(lit)),
    ]
