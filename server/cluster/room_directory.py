"""Interface through which the ingress finds the host of a room."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol


class RoomUnavailable(Exception):
    """The room does not exist, or there is no place for a new one; one line."""


class RoomNotReady(Exception):
    """The room has no address yet because it is being opened or moved. Try again."""


@dataclass(frozen=True)
class Address:
    """Address of a room's host."""

    url: str
    """For example `ws://10.0.0.7:40123`, within the cluster."""
    token: str
    """Token of the host."""


class RoomDirectory(Protocol):
    """Finds rooms of the cluster."""

    async def find(self, room_id: str, may_open: bool, client: str = "", *, is_private: bool = False) -> Address:
        """The room's host. Raises RoomNotReady, RoomUnavailable.

        `client`: whom the room counts for if it is opened (`quota.client_of`). `is_private`: nobody else can enter it.
        """
        ...

    async def release(self, room_id: str) -> bool:
        """The only client of a private room has left. Returns whether its place is free: a session may be kept."""
        ...

    async def abandon(self, room_id: str) -> None:
        """The only client of a private room left before the room was ready: give up its place, or the wait for one."""
        ...

    async def has_place(self) -> bool:
        """Whether a new room would find a place now."""
        ...
