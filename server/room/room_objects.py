"""The virtual objects of one room. Objects placed before the first frame wait until the up direction is known."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from protocol.codec import one_line
from server.objects.rasterize import Placed
from server.objects.scene_objects import SceneObjects, check_room
from server.opencl.engine import Engine
from server.scene.mesh import Mesh
from server.scene.placement import Placement, bottom_center, check_size, model_size

Place = NDArray[np.float64] | Placement
"""world_from_model [4, 4], or the requested placement while the up direction is unknown."""

MAX_PENDING = 256
"""Beyond it, the oldest pending names are forgotten."""


@dataclass(frozen=True)
class ObjectRecord:
    """Data to recreate an object."""

    object_id: str
    mesh: Mesh
    place: Place


@dataclass(frozen=True)
class Inventory:
    """All objects of a room at one moment."""

    revision: int
    """Increases with every change."""
    objects: tuple[ObjectRecord, ...]
    """Includes waiting objects, in order of placement."""
    has_begun: bool
    pending: tuple[str, ...]
    """Names of objects that were acknowledged but are not placed yet, since their client is not aligned or has not seen
    their spot."""


class RoomObjects:
    """Objects are placed, moved and removed by id. The caller holds the room's lock, except for `inventory`."""

    def __init__(self, engine: Engine) -> None:
        self._engine = engine
        self._objects: SceneObjects | None = None
        self._waiting: list[tuple[str, Mesh, Placement]] = []
        self._pending: dict[str, None] = {}
        self._revision = 0
        self._changing = threading.Lock()
        """Guards against `inventory`, which is called without the room's lock."""

    @property
    def has_begun(self) -> bool:
        """Whether the up direction is known."""
        return self._objects is not None

    @property
    def up(self) -> NDArray[np.float64]:
        """Unit vector in world axes; only after `begin`."""
        assert self._objects is not None
        return self._objects.up

    def begin(self, up: NDArray[np.float64]) -> None:
        """Place the waiting objects. up: unit vector in world axes."""
        with self._change():
            self._objects = SceneObjects(self._engine, up)
            for object_id, mesh, placement in self._waiting:
                self._objects.place(object_id, mesh, placement)
            self._waiting.clear()

    def set_up(self, up: NDArray[np.float64]) -> None:
        """Set another up direction, after `begin`: objects turn about the points they were placed at. up: [3] unit."""
        assert self._objects is not None
        with self._change():
            self._objects.set_up(up)

    def inventory(self) -> Inventory:
        """Snapshot of all objects. Thread-safe."""
        with self._changing:
            standing = self._objects.entries() if self._objects else {}
            objects = (
                *(ObjectRecord(name, entry.mesh, entry.world_from_model) for name, entry in standing.items()),
                *(ObjectRecord(name, mesh, placement) for name, mesh, placement in self._waiting),
            )
            return Inventory(self._revision, objects, self._objects is not None, tuple(self._pending))

    def kept(self) -> list[ObjectRecord]:
        """All objects, including waiting ones, in order of placement."""
        return list(self.inventory().objects)

    def restore(self, kept: ObjectRecord) -> None:
        """Recreate an object from a record, after `begin` if its pose was known. Raises ValueError."""
        if isinstance(kept.place, Placement):
            self.place(kept.object_id, kept.mesh, kept.place)
        else:
            assert self._objects is not None
            with self._change():
                self._objects.put(kept.object_id, kept.mesh, kept.place)

    def restore_place(self, object_id: str, place: Place) -> None:
        """Apply a later move to a recreated object. Does nothing if the object is missing."""
        known = {kept.object_id: kept.place for kept in self.kept()}
        if type(known.get(object_id)) is not type(place):
            return
        if isinstance(place, Placement):
            self.move(object_id, place)
        else:
            assert self._objects is not None
            with self._change():
                self._objects.move_to(object_id, place)

    def resume(self, revision: int, pending: tuple[str, ...]) -> None:
        """Restore the revision and the pending names after all objects were recreated."""
        self._revision, self._pending = revision, dict.fromkeys(pending)

    def place(self, object_id: str, mesh: Mesh, placement: Placement) -> None:
        """Place a mesh; replaces an object with the same id. Raises ValueError."""
        with self._change():
            if self._objects is None:
                others = [w for w in self._waiting if w[0] != object_id]
                check_room((other for _, other, _ in others), mesh)
                check_size(mesh, placement)
                self._waiting = [*others, (object_id, mesh, placement)]
            else:
                self._objects.place(object_id, mesh, placement)
            self._pending.pop(object_id, None)

    def move(self, object_id: str, placement: Placement) -> None:
        """Move an object. Raises KeyError for an unknown id."""
        with self._change():
            if self._objects is not None:
                self._objects.move(object_id, placement)
                return
            index = self._waiting_index(object_id)
            check_size(self._waiting[index][1], placement)
            self._waiting[index] = (object_id, self._waiting[index][1], placement)

    def remove(self, object_id: str) -> None:
        """Remove an object, placed or pending. Raises KeyError for an unknown id."""
        with self._change():
            is_pending = object_id in self._pending
            self._pending.pop(object_id, None)
            if is_pending and not self._is_there(object_id):
                return
            if self._objects is not None:
                self._objects.remove(object_id)
            else:
                del self._waiting[self._waiting_index(object_id)]

    def add_pending(self, object_id: str) -> None:
        """Note an object that was acknowledged, but cannot be placed before its client is aligned or sees its spot."""
        with self._change():
            self._pending[object_id] = None
            while len(self._pending) > MAX_PENDING:
                del self._pending[next(iter(self._pending))]

    def remove_pending(self, object_id: str) -> None:
        """Forget a pending object."""
        with self._change():
            self._pending.pop(object_id, None)

    def pending_notes(self, besides: set[str]) -> tuple[str, ...]:
        """A note that lists pending objects other than `besides`, if there are any."""
        names = [repr(name) for name in self._pending if name not in besides]
        if not names:
            return ()
        return (
            one_line(
                "objects that were not placed, because their client was not aligned with the room or did not see their "
                f"spot; place them again or remove them: {', '.join(names)}"
            ),
        )

    def placed(self, volume_from_world: NDArray[np.float64]) -> list[Placed]:
        """All objects with their volume_from_model; only after `begin`."""
        assert self._objects is not None
        return self._objects.placed(volume_from_world)

    def middles(self) -> dict[str, NDArray[np.float64]]:
        """[3] world metres: the middle of each placed object's box, by name in order of placement."""
        entries = self._objects.entries() if self._objects else {}
        return {
            name: entry.world_from_model[:3, :3] @ np.mean(entry.mesh.bounds, axis=0) + entry.world_from_model[:3, 3]
            for name, entry in entries.items()
        }

    def floors(self, besides: str) -> NDArray[np.float64]:
        """[k, 4] world metres: the middle of the floor of each placed object but one, and half its diagonal."""
        entries = self._objects.entries() if self._objects else {}
        rows = [np.zeros((0, 4))]
        for name, entry in entries.items():
            if name != besides:
                linear = entry.world_from_model[:3, :3]
                middle = linear @ bottom_center(entry.mesh) + entry.world_from_model[:3, 3]
                radius_m = 0.5 * model_size(entry.mesh)[0] * float(np.linalg.norm(linear[:, 0]))
                rows.append(np.array([[*middle, radius_m]]))
        return np.concatenate(rows)

    def clear(self) -> None:
        """Remove all objects."""
        if self._objects is not None:
            self._objects.clear()

    @contextmanager
    def _change(self) -> Iterator[None]:
        with self._changing:
            yield
            self._revision += 1

    def _is_there(self, object_id: str) -> bool:
        stands = self._objects is not None and object_id in self._objects.entries()
        return stands or any(name == object_id for name, _, _ in self._waiting)

    def _waiting_index(self, object_id: str) -> int:
        names = [name for name, _, _ in self._waiting]
        if object_id not in names:
            raise KeyError(object_id)
        return names.index(object_id)
