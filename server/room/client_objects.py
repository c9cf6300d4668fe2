"""The virtual objects of one client. Objects placed before it is aligned with its room wait."""

from __future__ import annotations

from server.objects.scene_objects import check_room
from server.room.room import Room
from server.scene.mesh import Mesh
from server.scene.placement import Placement, check_size
from server.tracking.alignment import Alignment


class ClientObjects:
    """Placements are in the client's world. The caller holds the room's lock."""

    def __init__(self, room: Room, alignment: Alignment) -> None:
        self._room = room
        self._alignment = alignment
        self._waiting: dict[str, tuple[Mesh, Placement]] = {}

    @property
    def waiting(self) -> frozenset[str]:
        """Names of the waiting objects."""
        return frozenset(self._waiting)

    def place(self, object_id: str, mesh: Mesh, placement: Placement) -> tuple[str, ...]:
        """Place a mesh in the room; replaces an object with the same id. Returns notes. Raises ValueError, one line."""
        objects = self._room.objects
        if self._alignment.is_settled or not objects.has_begun:
            objects.place(object_id, mesh, self._alignment.placed(placement))
            self._room.changes += 1
            return mesh.notes
        check_room((other for name, (other, _) in self._waiting.items() if name != object_id), mesh)
        check_size(mesh, placement)
        self._waiting.pop(object_id, None)
        self._waiting[object_id] = mesh, placement
        objects.add_pending(object_id)
        return (*mesh.notes, "it is placed once this client is aligned with the room")

    def move(self, object_id: str, placement: Placement) -> None:
        """Move an object. Raises KeyError for an unknown id, ValueError as place()."""
        if object_id not in self._waiting:
            self._room.objects.move(object_id, self._alignment.placed(placement))
            return
        mesh, _ = self._waiting[object_id]
        check_size(mesh, placement)
        del self._waiting[object_id]
        self._waiting[object_id] = mesh, placement

    def remove(self, object_id: str) -> None:
        """Remove an object. Raises KeyError for an unknown id."""
        if self._waiting.pop(object_id, None) is not None:
            self._room.objects.remove_pending(object_id)
            return
        self._room.objects.remove(object_id)
        self._room.changes += 1

    def place_waiting(self) -> tuple[str, ...]:
        """Place the waiting objects once the client is aligned. Returns problems, one line each."""
        if not self._waiting or not (self._alignment.is_settled and self._room.objects.has_begun):
            return ()
        problems = []
        for object_id, (mesh, placement) in self._waiting.items():
            try:
                self._room.objects.place(object_id, mesh, self._alignment.placed(placement))
            except ValueError as error:
                problems.append(f"object {object_id!r}: {error}")
        self._waiting.clear()
        self._room.changes += 1
        return tuple(problems)
