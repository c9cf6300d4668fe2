"""Rooms as named Ray actors: found by name, created where a place is free, restarted if their node fails."""

from __future__ import annotations

import asyncio
import logging
from typing import Any

import ray
from ray.actor import exit_actor
from ray.exceptions import RayActorError

from server.cluster.host import HostStatus, open_room_host
from server.cluster.room_directory import Address, RoomNotReady, RoomUnavailable
from server.cluster.settings import ClusterSettings
from server.service.monitoring.event_log import log_events

NAMESPACE = "probeless"
PREFIX = "room-"
ANSWER_S = 5.0
log = logging.getLogger(__name__)


class RoomActor:
    """Ray actor around a `RoomHost`."""

    def __init__(self, settings: ClusterSettings) -> None:
        log_events("json")
        self._host = open_room_host(settings)

    def address(self) -> Address:
        """Of `RoomHost`."""
        return self._host.address()

    def status(self) -> HostStatus:
        """Of `RoomHost`."""
        return self._host.status()

    def leave(self) -> bool:
        """See `RoomHost`; the actor ends too, which frees its name."""
        if not self._host.leave():
            return False
        exit_actor()
        return True


class RayRoomDirectory:
    """Room directory backed by Ray's actor registry."""

    def __init__(self, settings: ClusterSettings) -> None:
        self._settings = settings

    async def find(self, room_id: str, may_open: bool) -> Address:
        """The room's host. Raises RoomNotReady, RoomUnavailable."""
        try:
            actor = await asyncio.to_thread(self._actor, room_id, may_open)
            async with asyncio.timeout(ANSWER_S):
                address: Address = await actor.address.remote()
        except (RayActorError, TimeoutError) as error:
            raise RoomNotReady(str(error)) from error
        return address

    def _actor(self, room_id: str, may_open: bool) -> Any:
        name = PREFIX + room_id
        if not may_open:
            try:
                return ray.get_actor(name, NAMESPACE)
            except ValueError as error:
                raise RoomUnavailable("there is no such session: it ended, or its room was closed") from error
        most = self._settings.policy.most
        names = room_names()
        if name not in names and len(names) >= most:
            raise RoomUnavailable(f"the server is full: {most} rooms are open, which is the most: try again later")
        return ray.remote(RoomActor).options(**actor_options(name, self._settings.place)).remote(self._settings)


def actor_options(name: str, place: dict[str, float]) -> dict[str, Any]:
    """Actor options: detached from its creator, restarted without limit, with the resources of one place."""
    others = {kind: share for kind, share in place.items() if kind not in ("CPU", "GPU")}
    return {
        "name": name,
        "namespace": NAMESPACE,
        "get_if_exists": True,
        "lifetime": "detached",
        "max_restarts": -1,
        "num_cpus": place.get("CPU", 0.0),
        "num_gpus": place.get("GPU", 0.0),
        "resources": others,
        "scheduling_strategy": "SPREAD",
    }


def room_names() -> list[str]:
    """Names of all room actors, including those that wait for a place."""
    found = ray.util.list_named_actors(all_namespaces=True)
    return [one["name"] for one in found if one["namespace"] == NAMESPACE and one["name"].startswith(PREFIX)]
