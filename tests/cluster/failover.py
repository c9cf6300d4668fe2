"""Two nodes of Ray on this machine, four rooms, a client in each; one node is killed, and its rooms come back.

    python -m tests.cluster.failover

Prints one JSON object: when each room's client had an answer again, and whether the room still knew its object. Needs
the extra `cluster`. Both nodes see one folder, as nodes of a cluster see a shared one; the head's node is not killed.
"""

from __future__ import annotations

import asyncio
import contextlib
import json
import os
import signal
import sys
import tempfile
import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any

TOKEN = "failover"
PATIENCE_S = 600.0
"""For what has no bound of its own; longer is taken to hang."""
ROOMS = 4
FRAMES_BEFORE = 5
SAVED_WITHIN_S = 6.0
"""Rooms are saved every two seconds; more is not waited for."""
KEEP_S = 240.0
STEP_S = 0.3

# What Ray reads when it is loaded, so before it is. A node that is silent for so long is dead:
os.environ |= {
    "RAY_health_check_initial_delay_ms": "1000",
    "RAY_health_check_period_ms": "1000",
    "RAY_health_check_timeout_ms": "2000",
    "RAY_health_check_failure_threshold": "3",
    # Of proxies, which a busy machine makes wait: only the node must be found dead soon.
    "RAY_SERVE_PROXY_READY_CHECK_TIMEOUT_S": "60",
    "RAY_SERVE_PROXY_HEALTH_CHECK_TIMEOUT_S": "60",
    "RAY_SERVE_HAPROXY_STARTUP_TIMEOUT_S": "60",
    "RAY_SERVE_ENABLE_HA_PROXY": os.environ.get("RAY_SERVE_ENABLE_HA_PROXY", "1"),
    "RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO": "0",
    "PROBELESS_TOKEN": TOKEN,
    "OPENBLAS_NUM_THREADS": "1",
}

import ray  # noqa: E402
from ray import serve  # noqa: E402
from ray.cluster_utils import Cluster  # noqa: E402

from client.streaming.client import Answer, RoomPlace, StreamClient  # noqa: E402
from client.streaming.opening import ClientError  # noqa: E402
from server.cluster.application import build  # noqa: E402
from server.cluster.ray_directory import NAMESPACE, PREFIX  # noqa: E402
from server.cluster.routing import room_id_of  # noqa: E402
from server.scene.vase import vase_glb  # noqa: E402
from tests.scenes.rooms import CAMERA, frame_at, view_at, wishes  # noqa: E402


@dataclass
class Guest:
    """A client in a room of its own."""

    room: str
    client: StreamClient
    answered_s: list[float] = field(default_factory=list)
    tasks: list[asyncio.Task[None]] = field(default_factory=list)
    back: float | None = None
    """When the first picture came by a new connection."""

    async def send(self) -> None:
        """Frames for ever, and a little rest after each."""
        index = 0
        while True:
            await self.client.send_frame(frame_at(view_at(index % 20), index, given=view_at(index % 20)))
            index += 1
            await asyncio.sleep(STEP_S)

    async def receive(self) -> None:
        """Note when pictures came."""
        async for answer in self.client.answers():
            if isinstance(answer, Answer):
                self.answered_s.append(time.perf_counter())
                if self.client.reconnected and self.back is None:
                    self.back = self.answered_s[-1]


@contextlib.contextmanager
def two_nodes(places: int, port: int) -> Iterator[tuple[str, Cluster, Any]]:
    """The address of a service on two nodes with so many places each, the cluster, and its node besides the head."""
    with tempfile.TemporaryDirectory() as folder:
        os.environ["PROBELESS_KEYS"] = f"{folder}/keys"
        cluster = Cluster(initialize_head=True, head_node_args={"num_cpus": 2, "resources": {"room": places}})
        other = cluster.add_node(num_cpus=0, resources={"room": places})
        ray.init(address=cluster.address, log_to_driver="-v" in sys.argv)
        try:
            port = int(os.environ.get("PROBELESS_PORT", str(port)))
            serve.start(http_options={"host": "127.0.0.1", "port": port})
            serve.run(build({"data": f"{folder}/rooms", "place": {"room": 1.0}, "ingress_cpus": 0.1}), name="probeless")
            yield f"http://127.0.0.1:{port}/?token={TOKEN}", cluster, other
        finally:
            serve.shutdown()
            ray.shutdown()
            cluster.shutdown()


def main() -> int:
    """Run it; 0 if every room came back."""
    with two_nodes(ROOMS, 18321) as (url, cluster, doomed):
        result = asyncio.run(play(url, cluster, doomed))
    sys.stdout.write(json.dumps(result, indent=1) + "\n")
    return 0 if all(room["object_kept"] and room["longest_pause_s"] is not None for room in result["rooms"]) else 1


async def play(url: str, cluster: Cluster, doomed: Any) -> dict[str, Any]:
    """What happened."""
    began = time.perf_counter()
    guests = [await enter(url, f"room {number}") for number in range(ROOMS)]
    opened_s = time.perf_counter() - began
    try:
        await until(lambda: all(len(guest.answered_s) >= FRAMES_BEFORE for guest in guests), PATIENCE_S)
        await asyncio.sleep(SAVED_WITHIN_S)
        nodes = {guest.room: await node_of(guest.room) for guest in guests}
        moved = [guest for guest in guests if nodes[guest.room] == doomed.node_id]
        killed = time.perf_counter()
        sys.stderr.write(f"killed at {time.strftime('%H:%M:%S')}\n")
        starts = [asyncio.create_task(process_back(guest.room, doomed.node_id)) for guest in moved]
        await asyncio.to_thread(kill, cluster, doomed)
        await until(lambda: all(guest.back is not None for guest in moved), PATIENCE_S)
        return {
            "processors": os.cpu_count(),
            "rooms_opened_s": round(opened_s, 1),
            "rooms_of_the_killed_node": len(moved),
            "processes_back_s": [round(when - killed, 1) for when in await asyncio.gather(*starts)],
            "rooms": [await told(guest, guest in moved, killed) for guest in guests],
        }
    finally:
        for guest in guests:
            for task in guest.tasks:
                task.cancel()
            await guest.client.close()


async def enter(url: str, room: str) -> Guest:
    """A client that streams, with an object in its room."""
    client = await admitted(url, room)
    guest = Guest(room, client)
    guest.tasks = [asyncio.create_task(guest.receive()), asyncio.create_task(guest.send())]
    placed = await client.place_object("vase", "glb", vase_glb(), position_m=(-0.9, 0.6, 1.0))
    if placed.error is not None:
        raise RuntimeError(placed.error)
    return guest


async def admitted(url: str, room: str) -> StreamClient:
    """A client in its room. Hosts that have just begun compile their kernels, and the ingress says: try again."""
    until_s = time.perf_counter() + PATIENCE_S
    while True:
        client = await StreamClient.connect(url)
        try:
            await client.hello(CAMERA, wishes("given"), room=RoomPlace(room), keep_s=KEEP_S)
        except ClientError as error:
            await client.close()
            if "try again" not in str(error) or time.perf_counter() > until_s:
                raise
        else:
            return client


async def told(guest: Guest, has_moved: bool, killed: float) -> dict[str, Any]:
    """One room's end of the story."""
    moved = await guest.client.move_object("vase", (-0.8, 0.6, 1.0))
    later = [when - killed for when in guest.answered_s if when > killed]
    pauses = [b - a for a, b in zip([0.0, *later], later, strict=False)]
    return {
        "room": guest.room,
        "moved": has_moved,
        "back_s": None if guest.back is None else round(guest.back - killed, 1),
        "longest_pause_s": round(max(pauses), 1) if pauses else None,
        "object_kept": moved.error is None,
        "reconnected": guest.client.reconnected,
    }


async def node_of(room: str) -> str:
    """Where its host runs."""
    actor = await asyncio.to_thread(ray.get_actor, PREFIX + room_id_of(room), NAMESPACE)
    status = await actor.status.remote()
    return str(status.node)


async def process_back(room: str, old_node: str) -> float:
    """When its host runs on another node."""
    while True:
        with contextlib.suppress(ray.exceptions.RayError, TimeoutError):
            async with asyncio.timeout(1.0):
                if await node_of(room) != old_node:
                    return time.perf_counter()
        await asyncio.sleep(0.1)


def kill(cluster: Cluster, node: Any) -> None:
    """All of the node's processes at once, as when its machine is switched off."""
    for process in node.live_processes():
        os.kill(process[1].pid, signal.SIGKILL)
    cluster.remove_node(node, allow_graceful=False)


async def until(holds: Any, patience_s: float) -> None:
    """Raises TimeoutError."""
    async with asyncio.timeout(patience_s):
        while not holds():
            await asyncio.sleep(0.05)


if __name__ == "__main__":
    sys.exit(main())
