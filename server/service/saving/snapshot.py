"""The state of a room at one moment, as it is saved."""

from __future__ import annotations

from dataclasses import dataclass

from server.room.room_objects import Inventory, ObjectRecord
from server.service.saving.brick_files import Batch
from server.service.saving.room_state import RoomState
from server.volume.volume import Volume


@dataclass(frozen=True)
class Snapshot:
    """State of a room at one moment, with the bricks that have changed since the slot's save."""

    state: RoomState
    """Without objects and without the volume's file names."""
    inventory: Inventory
    volume: Volume | None
    bricks: list[Batch]
    change: int
    """The volume's `changes` at that time."""
    lock_ms: float = 0.0
    """How long the room's lock was held."""

    @property
    def objects(self) -> tuple[ObjectRecord, ...]:
        """All virtual objects."""
        return self.inventory.objects
