"""The virtual objects of one room: those that are asked for before the first frame wait for it to say what is up."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from server.opencl.engine import Engine
from server.scene.mesh import Mesh
from server.scene.objects import SceneObjects, check_room
from server.scene.placement import Placement, check_size
from server.stages.rasterize import Placed


@dataclass(frozen=True)
class KeptObject:
    """What an object is made of anew."""

    object_id: str
    mesh: Mesh
    place: NDArray[np.float64] | Placement
    """world_from_model [4, 4]; where it is not known yet what is up, what was asked for."""


class RoomObjects:
    """Placed, moved and removed by their ids, at any time."""

    def __init__(self, engine: Engine) -> None:
        self._engine = engine
        self._objects: SceneObjects | None = None
        self._waiting: list[tuple[str, Mesh, Placement]] = []

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
        self._objects = SceneObjects(self._engine, up)
        for object_id, mesh, placement in self._waiting:
            self._objects.place(object_id, mesh, placement)
        self._waiting.clear()

    def kept(self) -> list[KeptObject]:
        """All objects, those that wait too, in the order in which they came."""
        standing = self._objects.entries() if self._objects else {}
        return [
            *(KeptObject(name, entry.mesh, entry.world_from_model) for name, entry in standing.items()),
            *(KeptObject(name, mesh, placement) for name, mesh, placement in self._waiting),
        ]

    def put_back(self, kept: KeptObject) -> None:
        """Make one of the `kept` anew, after `begin` where it stood. Raises ValueError, one line."""
        if isinstance(kept.place, Placement):
            self.place(kept.object_id, kept.mesh, kept.place)
        else:
            assert self._objects is not None
            self._objects.put(kept.object_id, kept.mesh, kept.place)

    def place(self, object_id: str, mesh: Mesh, placement: Placement) -> None:
        """Put a mesh into the scene, in the place of one with the same id. Raises ValueError."""
        if self._objects is None:
            others = [w for w in self._waiting if w[0] != object_id]
            check_room((other for _, other, _ in others), mesh)
            check_size(mesh, placement)
            self._waiting = [*others, (object_id, mesh, placement)]
        else:
            self._objects.place(object_id, mesh, placement)

    def move(self, object_id: str, placement: Placement) -> None:
        """Give an object another place. Raises KeyError if there is none of that id."""
        if self._objects is not None:
            self._objects.move(object_id, placement)
            return
        index = self._waiting_index(object_id)
        check_size(self._waiting[index][1], placement)
        self._waiting[index] = (object_id, self._waiting[index][1], placement)

    def remove(self, object_id: str) -> None:
        """Take an object away. Raises KeyError if there is none of that id."""
        if self._objects is not None:
            self._objects.remove(object_id)
        else:
            del self._waiting[self._waiting_index(object_id)]

    def placed(self, volume_from_world: NDArray[np.float64]) -> list[Placed]:
        """Each object with its volume_from_model; once it has begun."""
        assert self._objects is not None
        return self._objects.placed(volume_from_world)

    def clear(self) -> None:
        """Take all objects away."""
        if self._objects is not None:
            self._objects.clear()

    def _waiting_index(self, object_id: str) -> int:
        names = [name for name, _, _ in self._waiting]
        if object_id not in names:
            raise KeyError(object_id)
        return names.index(object_id)
