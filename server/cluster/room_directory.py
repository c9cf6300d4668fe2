"""Where rooms are: what the ingress asks, whoever answers it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol


class RoomUnavailable(Exception):
    """There is no such room, or no place for one more; one line."""


class RoomNotReady(Exception):
    """The room has no address at the moment: it is being opened, or moves. To be asked again."""


@dataclass(frozen=True)
class Address:
    """Of a room's host."""

    url: str
    """As `ws://10.0.0.7:40123`, within the cluster."""
    token: str
    """That the host asks for."""


class RoomDirectory(Protocol):
    """The rooms of the cluster."""

    async def find(self, room_id: str, may_open: bool) -> Address:
        """The room's host. Raises RoomNotReady, RoomUnavailable."""
        ...
