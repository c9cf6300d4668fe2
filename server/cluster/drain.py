"""Moves the rooms of a node to other nodes before it is stopped: `python -m server.cluster.drain [NODE_ID]`.

Without a node it is the one that this runs on, as in a container's preStop hook. Ray places nothing on the node any
more; each of its rooms is saved and closed, and its clients are told to come again (1012): the ingress opens the room
elsewhere.
"""

from __future__ import annotations

import argparse
import contextlib
import subprocess
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import ray
from ray.exceptions import RayError

from server.cluster.host import HostStatus
from server.cluster.ray_directory import NAMESPACE, room_names

DEADLINE_S = 25
"""Rooms take up to 10 s; containers are killed 30 s after they were told to stop."""
ANSWER_S = 5.0


def main() -> int:
    """Exit status 0 once no room is left on the node, 1 where one is."""
    parser = argparse.ArgumentParser(prog="python -m server.cluster.drain", description=__doc__)
    parser.add_argument("node", nargs="?", help="id of the node; default: this one")
    node = parser.parse_args().node
    ray.init(address="auto", log_to_driver=False)
    node = node or ray.get_runtime_context().get_node_id()
    refuse_rooms(node)
    left = move_rooms(node)
    sys.stdout.write(f"{len(left)} rooms are left on {node}\n")
    return 1 if left else 0


def refuse_rooms(node: str) -> None:
    """Ray places nothing on this node any more. Raises CalledProcessError."""
    program = str(Path(sys.executable).with_name("ray"))
    reason = ("--reason", "DRAIN_NODE_REASON_PREEMPTION", "--reason-message", "its rooms move to other nodes")
    address = ("--address", ray.get_runtime_context().gcs_address)
    limit = ("--deadline-remaining-seconds", str(DEADLINE_S))
    subprocess.run([program, "drain-node", *address, "--node-id", node, *reason, *limit], check=True)


def move_rooms(node: str) -> list[str]:
    """Save and close all rooms of the node at once; the names of those that did not end in time."""
    actors = actors_of(room_names())
    here = on_node(statuses_of(actors), node)
    leaving = {actors[name].leave.remote(True): name for name in here}
    # An actor that ends is an answer too: RayError is raised for it when it is fetched, which nobody does.
    _, late = ray.wait(list(leaving), num_returns=len(leaving), timeout=DEADLINE_S) if leaving else ([], [])
    return [leaving[reference] for reference in late]


def actors_of(names: list[str]) -> dict[str, Any]:
    """The rooms' actors by name; those that have just ended are left out."""
    found = {}
    for name in names:
        with contextlib.suppress(ValueError):
            found[name] = ray.get_actor(name, NAMESPACE)
    return found


def statuses_of(actors: Mapping[str, Any]) -> dict[str, HostStatus]:
    """What the rooms say; those that are being opened or moved are left out."""
    asked = {name: actor.status.remote() for name, actor in actors.items()}
    if asked:
        ray.wait(list(asked.values()), num_returns=len(asked), timeout=ANSWER_S)
    found = {}
    for name, answer in asked.items():
        with contextlib.suppress(RayError):  # of which a time limit is one
            found[name] = ray.get(answer, timeout=0.1)
    return found


def on_node(rooms: Mapping[str, HostStatus], node: str) -> list[str]:
    """Names of the rooms that are on this node."""
    return [name for name, status in rooms.items() if status.node == node]


if __name__ == "__main__":
    sys.exit(main())
