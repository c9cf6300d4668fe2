"""What is saved of a room: its state at one moment."""

from __future__ import annotations

from dataclasses import dataclass

from server.room.room_objects import Inventory, KeptObject
from server.service.saving.brick_files import Batch
from server.service.saving.state import RoomState
from server.volume.volume import Volume


@dataclass(frozen=True)
class Snapshot:
    """All of a room, of its bricks those that have changed."""

    state: RoomState
    """Without the objects, and without the files of the volume."""
    inventory: Inventory
    volume: Volume | None
    bricks: list[Batch]
    change: int
    """The volume's `changes` at that moment."""
    lock_ms: float = 0.0
    """For how long no frame could be worked on."""

    @property
    def objects(self) -> tuple[KeptObject, ...]:
        """All of them."""
        return self.inventory.objects
