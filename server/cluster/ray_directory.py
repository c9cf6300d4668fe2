"""Rooms as named Ray actors: found by name, created where a place is free, restarted if their node fails."""

from __future__ import annotations

import asyncio
import contextlib
import logging
from collections.abc import Iterable
from typing import Any

import ray
from ray.actor import exit_actor
from ray.exceptions import RayActorError

from server.cluster.closing import is_enough
from server.cluster.host import HostStatus, open_room_host
from server.cluster.quota import Quota
from server.cluster.room_directory import Address, RoomNotReady, RoomUnavailable
from server.cluster.settings import ClusterSettings
from server.service.monitoring.event_log import log_events

NAMESPACE = "probeless"
PREFIX, QUOTA = "room-", "quota"
ANSWER_S = 5.0
ABANDON_TRIES, ABANDON_PAUSE_S = 5, 1.0
LEAVE_S = 20.0
"""Of a room that is saved and stopped."""
log = logging.getLogger(__name__)


class RoomActor:
    """Ray actor around a `RoomHost`."""

    def __init__(self, settings: ClusterSettings, is_private: bool) -> None:
        log_events("json")
        self._host = open_room_host(settings, is_private=is_private)

    def address(self) -> Address:
        """Of `RoomHost`."""
        return self._host.address()

    def status(self) -> HostStatus:
        """Of `RoomHost`."""
        return self._host.status()

    def leave(self, even_with_clients: bool = False) -> bool:
        """See `RoomHost`; the actor ends too, which frees its name."""
        if not self._host.leave(even_with_clients=even_with_clients):
            return False
        exit_actor()
        return True


class RayRoomDirectory:
    """Room directory backed by Ray's actor registry."""

    def __init__(self, settings: ClusterSettings) -> None:
        self._settings = settings
        self._starting: dict[str, asyncio.Task[Any]] = {}
        """Calls by which rooms are being opened; they go on where the client leaves."""
        self._given_up: set[str] = set()
        """Rooms that are being abandoned: such a call opens them no more."""

    async def find(self, room_id: str, may_open: bool, client: str = "", *, is_private: bool = False) -> Address:
        """The room's host. Raises RoomNotReady, RoomUnavailable."""
        try:
            actor = await asyncio.shield(self._start(room_id, may_open, client, is_private))
            async with asyncio.timeout(ANSWER_S):
                address: Address = await actor.address.remote()
        except (RayActorError, TimeoutError) as error:
            raise RoomNotReady(str(error)) from error
        return address

    async def release(self, room_id: str) -> bool:
        """Whether the place is free."""
        try:
            actor = await asyncio.to_thread(ray.get_actor, PREFIX + room_id, NAMESPACE)
            async with asyncio.timeout(LEAVE_S):
                return bool(await actor.leave.remote())
        except (RayActorError, ValueError):  # ended, or just ending
            return True
        except TimeoutError:
            return False

    def _start(self, room_id: str, may_open: bool, client: str, is_private: bool) -> asyncio.Task[Any]:
        task = asyncio.create_task(asyncio.to_thread(self._actor, room_id, may_open, client, is_private))
        self._starting[room_id] = task

        def forget(done: asyncio.Task[Any]) -> None:
            if self._starting.get(room_id) is done:
                del self._starting[room_id]
            if not done.cancelled():
                done.exception()  # of one that nobody awaits any more

        task.add_done_callback(forget)
        return task

    async def abandon(self, room_id: str) -> None:
        """Nothing of it is to be saved."""
        self._given_up.add(room_id)
        if (starting := self._starting.get(room_id)) is not None:
            await asyncio.wait((starting,))
        self._given_up.discard(room_id)
        for _ in range(ABANDON_TRIES):  # an actor that is just being registered is not found at once
            with contextlib.suppress(RayActorError, ValueError):
                actor = await asyncio.to_thread(ray.get_actor, PREFIX + room_id, NAMESPACE)
                await asyncio.to_thread(ray.kill, actor)
            await asyncio.sleep(ABANDON_PAUSE_S)

    async def has_place(self) -> bool:
        """Whether the resources of a place are free."""
        free = await asyncio.to_thread(ray.available_resources)
        names = await asyncio.to_thread(room_names)
        return len(names) < self._settings.policy.most and is_enough(free, self._settings.place)

    def _actor(self, room_id: str, may_open: bool, client: str, is_private: bool) -> Any:
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
        if name not in names and not ray.get(_quota(self._settings).claim.remote(room_id, client, _ids(names))):
            of_one = self._settings.rooms_per_client
            raise RoomUnavailable(
                f"your address {client} has {of_one} rooms open, which is the most: close one of them"
            )
        options = actor_options(name, self._settings.place)
        if room_id in self._given_up:
            raise RoomUnavailable("its client has left")
        return ray.remote(RoomActor).options(**options).remote(self._settings, is_private)


def _ids(names: Iterable[str]) -> list[str]:
    return [name.removeprefix(PREFIX) for name in names]


def _quota(settings: ClusterSettings) -> Any:
    """The one quota of the cluster. It forgets who opened which room if its node fails."""
    options = {"name": QUOTA, "namespace": NAMESPACE, "get_if_exists": True, "lifetime": "detached"}
    return ray.remote(Quota).options(**options, num_cpus=0, max_restarts=-1).remote(settings.rooms_per_client)


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
