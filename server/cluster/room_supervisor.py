"""Room supervisor: every few seconds closes empty rooms and requests capacity from the autoscaler."""

from __future__ import annotations

import asyncio
import contextlib
import logging
import time
from typing import Any

import ray
from ray.autoscaler.sdk import request_resources
from ray.exceptions import RayError
from ray.util.metrics import Gauge

from server.cluster.capacity import Capacity
from server.cluster.closing import is_enough, rooms_to_close
from server.cluster.host import HostStatus
from server.cluster.ray_directory import NAMESPACE, room_names
from server.cluster.settings import ClusterSettings

EVERY_S = 2.0
ANSWER_S = 5.0
log = logging.getLogger(__name__)


class RoomSupervisor:
    """A Serve deployment with one replica, which Serve restarts if it fails."""

    def __init__(self, settings: ClusterSettings) -> None:
        self._settings = settings
        self._capacity = Capacity(settings.policy)
        self._requested = 0
        self._rooms = Gauge("probeless_rooms", "Rooms that are open or wait for a place")
        self._places = Gauge("probeless_places_wanted", "Places for rooms that the cluster is asked for")
        self._age = Gauge("probeless_queue_age_seconds", "Age of frames when they are taken, mean over the rooms")
        self._task = asyncio.get_running_loop().create_task(self._run())

    def check_health(self) -> None:
        """Called by Serve. Raises the error that ended the supervisor."""
        if self._task.done():
            self._task.result()

    async def places(self) -> int:
        """Number of places requested last."""
        return self._requested

    async def _run(self) -> None:
        while True:
            names = await asyncio.to_thread(room_names)
            found = dict(zip(names, await asyncio.gather(*map(self._status_of, names)), strict=True))
            free = await asyncio.to_thread(ray.available_resources)
            is_full = not is_enough(free, self._settings.place)
            for name in rooms_to_close(found, self._settings.close_after_s, is_full=is_full):
                await self._close(name)
            ages = [status.queue_age_s for status in found.values() if status is not None and status.queue_age_s > 0]
            await self._request_places(len(names), sum(ages) / len(ages) if ages else 0.0)
            await asyncio.sleep(EVERY_S)

    async def _status_of(self, name: str) -> HostStatus | None:
        """The room's status; None if it waits for a place, is moving, or was just closed."""
        with contextlib.suppress(RayError, ValueError, TimeoutError):
            async with asyncio.timeout(ANSWER_S):
                actor: Any = await asyncio.to_thread(ray.get_actor, name, NAMESPACE)
                status: HostStatus = await actor.status.remote()
                return status
        return None

    async def _close(self, name: str) -> None:
        log.info("%s is closed: nobody is in it", name)
        with contextlib.suppress(RayError, ValueError):
            actor: Any = await asyncio.to_thread(ray.get_actor, name, NAMESPACE)
            actor.leave.remote()

    async def _request_places(self, rooms: int, queue_age_s: float) -> None:
        wanted = self._capacity.wanted(time.monotonic(), rooms, queue_age_s)
        self._rooms.set(rooms)
        self._places.set(wanted)
        self._age.set(queue_age_s)
        if wanted != self._requested:
            await asyncio.to_thread(request_resources, bundles=[dict(self._settings.place)] * wanted)
            self._requested = wanted
