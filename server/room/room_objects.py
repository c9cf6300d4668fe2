"""The virtual objects of one room: those that are asked for before the first frame wait for it to say what is up."""

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
from server.scene.placement import Placement, check_size

Place = NDArray[np.float64] | Placement
"""world_from_model [4, 4]; where it is not known yet what is up, what was asked for."""

MOST_OWED = 256


@dataclass(frozen=True)
class KeptObject:
    """What an object is made of anew."""

    object_id: str
    mesh: Mesh
    place: Place


@dataclass(frozen=True)
class Inventory:
    """All that is kept of a room's objects, at one moment."""

    revision: int
    """Grows with every change."""
    objects: tuple[KeptObject, ...]
    """Those that wait too, in the order in which they came."""
    has_begun: bool
    owed: tuple[str, ...]
    """Names of objects that were acknowledged and stand nowhere yet."""


class RoomObjects:
    """Placed, moved and removed by their ids, at any time, by whoever holds the room's lock."""

    def __init__(self, engine: Engine) -> None:
        self._engine = engine
        self._objects: SceneObjects | None = None
        self._waiting: list[tuple[str, Mesh, Placement]] = []
        self._owed: dict[str, None] = {}
        self._revision = 0
        self._changing = threading.Lock()
        """The inventory is taken by those too who do not hold the room's lock."""

    @property
    def has_begun(self) -> bool:
        """Whether it is known what is up."""
        return self._objects is not None

    @property
    def up(self) -> NDArray[np.float64]:
        """Unit, world; once it has begun."""
        assert self._objects is not None
        return self._objects.up

    def begin(self, up: NDArray[np.float64]) -> None:
        """Place what has waited. up: unit, world."""
        with self._change():
            self._objects = SceneObjects(self._engine, up)
            for object_id, mesh, placement in self._waiting:
                self._objects.place(object_id, mesh, placement)
            self._waiting.clear()

    def inventory(self) -> Inventory:
        """For any thread."""
        with self._changing:
            standing = self._objects.entries() if self._objects else {}
            objects = (
                *(KeptObject(name, entry.mesh, entry.world_from_model) for name, entry in standing.items()),
                *(KeptObject(name, mesh, placement) for name, mesh, placement in self._waiting),
            )
            return Inventory(self._revision, objects, self._objects is not None, tuple(self._owed))

    def kept(self) -> list[KeptObject]:
        """All objects, those that wait too, in the order in which they came."""
        return list(self.inventory().objects)

    def put_back(self, kept: KeptObject) -> None:
        """Make one of the `kept` anew, after `begin` where it stood. Raises ValueError, one line."""
        if isinstance(kept.place, Placement):
            self.place(kept.object_id, kept.mesh, kept.place)
        else:
            assert self._objects is not None
            with self._change():
                self._objects.put(kept.object_id, kept.mesh, kept.place)

    def move_back(self, object_id: str, place: Place) -> None:
        """Give one that was put back the place that it was moved to later; where it is not there, nothing."""
        known = {kept.object_id: kept.place for kept in self.kept()}
        if type(known.get(object_id)) is not type(place):
            return
        if isinstance(place, Placement):
            self.move(object_id, place)
        else:
            assert self._objects is not None
            with self._change():
                self._objects.move_to(object_id, place)

    def resume(self, revision: int, owed: tuple[str, ...]) -> None:
        """These hold after all has been put back."""
        self._revision, self._owed = revision, dict.fromkeys(owed)

    def place(self, object_id: str, mesh: Mesh, placement: Placement) -> None:
        """Put a mesh into the scene, in the place of one with the same id. Raises ValueError."""
        with self._change():
            if self._objects is None:
                others = [w for w in self._waiting if w[0] != object_id]
                check_room((other for _, other, _ in others), mesh)
                check_size(mesh, placement)
                self._waiting = [*others, (object_id, mesh, placement)]
            else:
                self._objects.place(object_id, mesh, placement)
            self._owed.pop(object_id, None)

    def move(self, object_id: str, placement: Placement) -> None:
        """Give an object another place. Raises KeyError if there is none of that id."""
        with self._change():
            if self._objects is not None:
                self._objects.move(object_id, placement)
                return
            index = self._waiting_index(object_id)
            check_size(self._waiting[index][1], placement)
            self._waiting[index] = (object_id, self._waiting[index][1], placement)

    def remove(self, object_id: str) -> None:
        """Take an object away, or what is owed. Raises KeyError if there is none of that id."""
        with self._change():
            is_owed = object_id in self._owed
            self._owed.pop(object_id, None)
            if is_owed and not self._is_there(object_id):
                return
            if self._objects is not None:
                self._objects.remove(object_id)
            else:
                del self._waiting[self._waiting_index(object_id)]

    def owe(self, object_id: str) -> None:
        """One has been acknowledged that cannot be placed yet, since its client does not know where it is."""
        with self._change():
            self._owed[object_id] = None
            while len(self._owed) > MOST_OWED:
                del self._owed[next(iter(self._owed))]

    def forgive(self, object_id: str) -> None:
        """It is not wanted any more."""
        with self._change():
            self._owed.pop(object_id, None)

    def owed_notes(self, besides: set[str]) -> tuple[str, ...]:
        """One line where there are any that were acknowledged and stand nowhere, the names `besides` left out."""
        names = [repr(name) for name in self._owed if name not in besides]
        if not names:
            return ()
        return (
            one_line(
                "not placed, since whoever asked was not aligned with the room; place or remove again what nobody "
                f"here waits for: {', '.join(names)}"
            ),
        )

    def placed(self, volume_from_world: NDArray[np.float64]) -> list[Placed]:
        """Each object with its volume_from_model; once it has begun."""
        assert self._objects is not None
        return self._objects.placed(volume_from_world)

    def clear(self) -> None:
        """Take all objects away."""
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
