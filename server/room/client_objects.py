"""The virtual objects of one client. Objects wait until it is aligned with its room, and until their spot is seen."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from itertools import product

import numpy as np
from numpy.typing import NDArray

from protocol.messages import PlacedObject
from server.objects.scene_objects import check_room
from server.room.room import Room
from server.room.spots import SpotUnseen, SpotView, find_spot
from server.scene.mesh import Mesh
from server.scene.placement import Placement, SpotPlacement, check_size
from server.tracking.alignment import Alignment
from server.volume.volume import Volume

EAGER, PAUSE = 10, 10
"""A spot that is not in view is sought in each of the first frames, then in one of so many: 30 ms each at 640x480."""

MOST_SEARCHES = 32
"""Objects for which horizontal surface is searched in one frame, at some 10 ms each; others wait for the next one."""


@dataclass(frozen=True)
class _Waiting:
    """An object that is not placed yet."""

    mesh: Mesh
    placement: Placement | SpotPlacement
    tries: int = 0
    """Frames in which its spot could have been sought."""

    @property
    def is_search(self) -> bool:
        """Whether finding its spot takes a search of the frame's surfaces."""
        return isinstance(self.placement, SpotPlacement) and self.placement.spot.on not in {"pixel", "ray"}

    def is_due(self, index: int) -> bool:
        """Whether its spot is to be sought in the client's frame `index`."""
        if isinstance(self.placement, Placement):
            return False
        frame = self.placement.spot.frame
        return index >= frame if frame is not None else self.tries < EAGER or self.tries % PAUSE == 0


class ClientObjects:
    """Placements are in the client's world. The caller holds the room's lock."""

    def __init__(self, room: Room, alignment: Alignment, width: int, height: int) -> None:
        """`width`, `height`: of the client's picture, pixels."""
        self._room = room
        self._alignment = alignment
        self._size = width, height
        self._waiting: dict[str, _Waiting] = {}
        self._unchecked: list[str] = []
        """Placed objects of which nothing was said yet."""
        self._found: list[PlacedObject] = []
        """Where objects stand whose spots were found since the last call of take_found()."""

    @property
    def waiting(self) -> frozenset[str]:
        """Names of the waiting objects."""
        return frozenset(self._waiting)

    def place(self, object_id: str, mesh: Mesh, placement: Placement | SpotPlacement) -> tuple[str, ...]:
        """Place a mesh in the room; replaces an object with the same id. Returns notes. Raises ValueError, one line."""
        objects = self._room.objects
        if isinstance(placement, Placement) and (self._alignment.is_settled or not objects.has_begun):
            self._waiting.pop(object_id, None)
            self._put(object_id, mesh, placement)
            return mesh.notes
        check_room((other.mesh for name, other in self._waiting.items() if name != object_id), mesh)
        self._check(mesh, placement)
        self._waiting.pop(object_id, None)
        self._waiting[object_id] = _Waiting(mesh, placement)
        objects.add_pending(object_id)
        self._room.changes += 1  # the next frame is not one that reuses the last one's geometry
        if self._alignment.is_settled or not objects.has_begun:
            return mesh.notes
        return (*mesh.notes, "it is placed once this client is aligned with the room")

    def move(self, object_id: str, placement: Placement) -> None:
        """Move an object. Raises KeyError for an unknown id, ValueError as place()."""
        if object_id not in self._waiting:
            self._room.objects.move(object_id, self._alignment.placed(placement))
            return
        mesh = self._waiting[object_id].mesh
        check_size(mesh, placement)
        del self._waiting[object_id]
        self._waiting[object_id] = _Waiting(mesh, placement)

    def remove(self, object_id: str) -> None:
        """Remove an object. Raises KeyError for an unknown id."""
        if self._waiting.pop(object_id, None) is not None:
            self._room.objects.remove_pending(object_id)
            return
        self._room.objects.remove(object_id)
        self._room.changes += 1

    def place_waiting(self, index: int) -> tuple[str, ...]:
        """Place the waiting objects whose place is known, once the client is aligned. Returns problems, one line each.

        index: the client's number of this frame. Where it is to show a pixel or a ray, it is not reused from the last.
        """
        if not self._waiting or not (self._alignment.is_settled and self._room.objects.has_begun):
            return ()
        problems = []
        for object_id, waiting in list(self._waiting.items()):
            if isinstance(waiting.placement, Placement):
                problems += self._settle(object_id, waiting.mesh, waiting.placement)
            elif waiting.placement.spot.on in {"pixel", "ray"} and waiting.is_due(index):
                self._room.changes += 1
        return tuple(problems)

    def place_on_spots(self, index: int, view: Callable[[], SpotView]) -> tuple[str, ...]:
        """Place the objects whose spots are in view. Returns notes, one line each.

        index: the client's number of this frame, view: makes its view, which shows the room as it is now; called only
        if a spot is to be sought.
        """
        if not self._waiting or not self._alignment.is_settled:
            return ()
        seen, searches, notes = None, 0, list[str]()
        for object_id, waiting in list(self._waiting.items()):
            if waiting.is_due(index):
                searches += waiting.is_search
                if waiting.is_search and searches > MOST_SEARCHES:
                    continue
                seen = seen or view()
                notes += self._find(object_id, waiting, seen)
            if object_id in self._waiting:
                self._waiting[object_id] = replace(waiting, tries=waiting.tries + 1)
        return tuple(notes)

    def check_placed(self, volume: Volume) -> tuple[str, ...]:
        """Notes on objects that were placed since the last frame and lie outside of the volume, or are larger."""
        entries = {kept.object_id: kept for kept in self._room.objects.kept()} if self._unchecked else {}
        notes = list[str]()
        for name in self._unchecked:
            kept = entries.get(name)
            if kept is not None and not isinstance(kept.place, Placement):
                problem = _volume_problem(kept.mesh, kept.place, volume)
                notes += [f"object {name!r} {problem}"] if problem else []
        self._unchecked.clear()
        return tuple(notes)

    def take_found(self) -> tuple[PlacedObject, ...]:
        """Where objects stand whose spots were found since the last call, in the client's world."""
        found, self._found = tuple(self._found), []
        return found

    def _find(self, object_id: str, waiting: _Waiting, view: SpotView) -> list[str]:
        placement, mesh = waiting.placement, waiting.mesh
        assert isinstance(placement, SpotPlacement)
        try:
            found = find_spot(view, mesh, placement, self._room.objects.floors(besides=object_id))
        except SpotUnseen as reason:
            return [f"object {object_id!r} waits: {reason}"] if waiting.tries == 0 else []
        except ValueError as error:
            self._forget(object_id)
            return [f"object {object_id!r} is not placed: {error}"]
        to_client = self._alignment.client_from_room
        x, y, z = (float(value) for value in to_client[:3, :3] @ found.position + to_client[:3, 3])
        problems = self._settle(object_id, mesh, placement.at((x, y, z), found.scale))
        if not problems:
            placed = PlacedObject(object=object_id, position_m=(x, y, z), scale=found.scale, yaw_deg=placement.yaw_deg)
            self._found.append(placed)
        return problems or [f"object {object_id!r} stands at {x:.3f},{y:.3f},{z:.3f} {found.words}"]

    def _settle(self, object_id: str, mesh: Mesh, placement: Placement) -> list[str]:
        """Place a waiting object. Returns problems."""
        self._forget(object_id)
        try:
            self._put(object_id, mesh, placement)
        except ValueError as error:
            return [f"object {object_id!r}: {error}"]
        return []

    def _put(self, object_id: str, mesh: Mesh, placement: Placement) -> None:
        self._room.objects.place(object_id, mesh, self._alignment.placed(placement))
        self._room.changes += 1
        self._unchecked.append(object_id)

    def _forget(self, object_id: str) -> None:
        del self._waiting[object_id]
        self._room.objects.remove_pending(object_id)

    def _check(self, mesh: Mesh, placement: Placement | SpotPlacement) -> None:
        """Raises ValueError for what cannot be placed wherever it is, and for a pixel beyond the picture."""
        if isinstance(placement, Placement):
            return check_size(mesh, placement)
        check_size(mesh, placement.at((0.0, 0.0, 0.0), placement.scale or 1.0))
        pixel, (width, height) = placement.spot.pixel, self._size
        if pixel is not None and not (0 <= round(pixel[0]) < width and 0 <= round(pixel[1]) < height):
            raise ValueError(f"pixel {pixel[0]:g},{pixel[1]:g} is beyond the picture of {width}x{height} pixels")
        return None


def _volume_problem(mesh: Mesh, world_from_model: NDArray[np.float64], volume: Volume) -> str | None:
    """What is wrong with an object's place or size in the scanned volume; None if nothing."""
    corners = np.array(list(product(*np.transpose(mesh.bounds)))) @ world_from_model[:3, :3].T + world_from_model[:3, 3]
    low, high = corners.min(axis=0), corners.max(axis=0)
    room_low, room_high = np.array(volume.bounds_m[:3]), np.array(volume.bounds_m[3:])
    size = " x ".join(f"{side:.1f}" for side in room_high - room_low)
    if ((high - low) > (room_high - room_low)).any():
        return f"is {(high - low).max():.1f} m long, larger than the scanned volume of {size} m: give a smaller scale"
    if (high < room_low).any() or (low > room_high).any():
        place = ",".join(f"{value:.2f}" for value in (low + high) / 2)
        return f"is at {place}, outside of the scanned volume of {size} m: nothing real hides it or is shaded by it"
    return None
