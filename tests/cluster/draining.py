"""Two nodes of Ray on this machine: rooms of clients that leave at once are not opened, a drained node's rooms move.

    python -m tests.cluster.draining

Prints one JSON object. Needs the extra `cluster`. Both nodes see one folder; the head's node is not drained.
"""

from __future__ import annotations

import asyncio
import json
import os
import re
import subprocess
import sys
import time
from typing import Any

from tests.cluster.failover import PATIENCE_S, Guest, enter, node_of, two_nodes, until  # first: it sets what Ray reads

import httpx  # isort: skip
import ray  # isort: skip

from client.streaming.client import StreamClient  # isort: skip
from server.cluster.ray_directory import room_names  # isort: skip
from tests.data import ROOT  # isort: skip
from tests.scenes.rooms import CAMERA, wishes  # isort: skip

PLACES = 2
"""Of each node."""
HURRIED = 11
"""Clients that leave at once."""


def main() -> int:
    """Run it; 0 if every place came back and no room was lost."""
    with two_nodes(PLACES, 18322) as (url, _, drained):
        result = asyncio.run(play(url, drained.node_id))
    sys.stdout.write(json.dumps(result, indent=1) + "\n")
    is_good = result["object_kept"] and result["moved"] and not result["opened_for_nobody"]
    return 0 if is_good and not result["left_open"] else 1


async def play(url: str, node: str) -> dict[str, Any]:
    """What happened."""
    began_s = time.perf_counter()
    guests = [await enter(url, f"room {number}") for number in range(PLACES)]  # spread: one on each node
    opened_s = time.perf_counter() - began_s
    opened = await rooms_opened(url)
    await asyncio.gather(*(hurry(url) for _ in range(HURRIED)))
    hurried_s = time.perf_counter()
    await until(lambda: len(room_names()) == len(guests), PATIENCE_S)
    returned_s = time.perf_counter() - hurried_s
    opened_for_nobody = await rooms_opened(url) - opened
    try:
        await until(lambda: all(len(guest.answered_s) >= 3 for guest in guests), PATIENCE_S)
        moved = [guest for guest in guests if await node_of(guest.room) == node]
        began_s = time.perf_counter()
        status = await asyncio.to_thread(drain, node)
        await until(lambda: all(guest.back is not None for guest in moved), PATIENCE_S)
        back_s = max(guest.back or 0.0 for guest in moved) - began_s
        kept = [(await guest.client.move_object("vase", (-0.8, 0.6, 1.0))).error is None for guest in guests]
        return {
            "rooms_opened_s": round(opened_s, 1),
            "places_back_s": round(returned_s, 1),
            "opened_for_nobody": opened_for_nobody,
            "left_open": len(room_names()) - len(guests),
            "drain_status": status,
            "rooms_of_the_node": len(moved),
            "moved": [await node_of(guest.room) != node for guest in moved] == [True] * len(moved) and len(moved) > 0,
            "back_s": round(back_s, 1),
            "object_kept": all(kept),
        }
    finally:
        await leave(guests)


async def rooms_opened(url: str) -> int:
    """How often the ingress has connected a client to its room. It connects none that has left."""
    address, _, token = url.partition("?token=")
    async with httpx.AsyncClient(trust_env=False, headers={"Authorization": f"Bearer {token}"}) as client:
        text = (await client.get(f"{address}metrics")).raise_for_status().text
    (count,) = re.findall(r"^probeless_ingress_wait_seconds_count (\S+)$", text, re.MULTILINE)
    return int(float(count))


async def hurry(url: str) -> None:
    """A hello whose client is gone before it is answered."""
    client = await StreamClient.connect(url)
    greeting = asyncio.create_task(client.hello(CAMERA, wishes("given")))
    await asyncio.sleep(0.2)
    greeting.cancel()
    await client.close()


def drain(node: str) -> int:
    """Exit status of the command."""
    command = [sys.executable, "-m", "server.cluster.drain", node]
    environment = os.environ | {"RAY_ADDRESS": ray.get_runtime_context().gcs_address}
    return subprocess.run(command, check=False, cwd=ROOT, env=environment).returncode


async def leave(guests: list[Guest]) -> None:
    """All of them."""
    for guest in guests:
        for task in guest.tasks:
            task.cancel()
        await guest.client.close()


if __name__ == "__main__":
    sys.exit(main())
