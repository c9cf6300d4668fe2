"""The virtual objects of a scene: uploaded once, moved by their placement."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from server.opencl.engine import Engine
from server.scene.mesh import Mesh
from server.scene.placement import Placement, world_from_model
from server.scene.virtual_object import VirtualObject
from server.stages.rasterize import Placed


@dataclass(frozen=True)
class _Entry:
    mesh: Mesh
    thing: VirtualObject
    world_from_model: NDArray[np.float64]


class SceneObjects:
    """Objects by id, in the order in which they came."""

    def __init__(self, engine: Engine, up: NDArray[np.float64]) -> None:
        self._engine = engine
        self.up = up
        self._entries: dict[str, _Entry] = {}

    def place(self, object_id: str, mesh: Mesh, placement: Placement) -> None:
        """Add a mesh, in the place of one with the same id."""
        entry = _Entry(mesh, VirtualObject.upload(self._engine, mesh), world_from_model(mesh, placement, self.up))
        if object_id in self._entries:
            self.remove(object_id)
        self._entries[object_id] = entry

    def move(self, object_id: str, placement: Placement) -> None:
        """Give an object another place. Raises KeyError if there is none of that id."""
        entry = self._entries[object_id]
        placed = world_from_model(entry.mesh, placement, self.up)
        self._entries[object_id] = _Entry(entry.mesh, entry.thing, placed)

    def remove(self, object_id: str) -> None:
        """Take an object away. Raises KeyError if there is none of that id."""
        self._entries.pop(object_id).thing.release()

    def clear(self) -> None:
        """Take all objects away."""
        for object_id in list(self._entries):
            self.remove(object_id)

    def placed(self, volume_from_world: NDArray[np.float64]) -> list[Placed]:
        """Each object with its volume_from_model."""
        return [(entry.thing, volume_from_world @ entry.world_from_model) for entry in self._entries.values()]
