"""Simulates one day of load for given autoscaler settings: waiting times and cost. Takes seconds.

Rooms arrive as a Poisson process with an hourly rate and stay for exponentially distributed times. Nodes take a while
to start, and are released when they are empty and not needed. A room is placed on the node with the fewest rooms and
stays there. Each room needs a share of the node's device; if the shares exceed the device, frames age.
"""

from __future__ import annotations

import heapq
import math
from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass, field
from itertools import count

import numpy as np
from numpy.typing import NDArray

from server.cluster.capacity import Capacity, Policy

DAY_S = 86400.0
TICK_S = 10.0
"""Interval between the supervisor's decisions."""
HOURS = (2, 1, 1, 1, 1, 2, 4, 8, 14, 20, 22, 24, 26, 24, 24, 26, 32, 44, 66, 88, 100, 82, 42, 12)
"""Arrival rate in each hour, in percent of the busiest hour. Assumes a service that is used after work."""


@dataclass(frozen=True)
class Load:
    """Load of one day."""

    busiest_per_hour: float = 120.0
    """Rooms that arrive in the busiest hour."""
    stay_s: float = 1200.0
    """Mean duration of a room."""
    share: float = 0.2
    """Mean share of a node's device that a room needs."""
    spread: float = 0.5
    """Standard deviation of its logarithm."""
    seed: int = 1


@dataclass(frozen=True)
class Fleet:
    """The machines."""

    places: int = 4
    """Rooms per node."""
    start_s: float = 150.0
    """Time from requesting a node to its first room."""
    patience_s: float = 20.0
    """Time that a client waits for its room."""
    frame_s: float = 0.1
    """Age of frames on a node that is not overloaded."""


@dataclass
class Node:
    """One machine."""

    ready_s: float
    rooms: dict[int, float] = field(default_factory=dict)
    """Device share of each room by number."""

    def age_s(self, frame_s: float) -> float:
        """Age of its frames when they are processed."""
        return frame_s * max(1.0, sum(self.rooms.values()))


@dataclass(frozen=True)
class Day:
    """Result; the series have one value per tick."""

    rooms: int
    """Rooms that arrived."""
    refused: int
    """Rooms refused after `Fleet.patience_s`."""
    waited_s: tuple[float, ...]
    """Waiting time of each admitted room."""
    node_hours: float
    open_rooms: NDArray[np.int64]
    places: NDArray[np.int64]
    wanted: NDArray[np.int64]
    aged_share: float
    """Share of all open-room time with frames older than the policy's limit."""

    @property
    def refused_share(self) -> float:
        """Share of all rooms that arrived."""
        return self.refused / max(self.rooms, 1)

    @property
    def used_share(self) -> float:
        """Share of the available places that were used, over the day."""
        return float(self.open_rooms.sum() / max(self.places.sum(), 1))

    def cost_per_thousand(self, price_per_node_hour: float, sessions_per_room: float) -> float:
        """Cost per 1000 sessions, in the price's currency."""
        sessions = (self.rooms - self.refused) * sessions_per_room
        return 1000 * price_per_node_hour * self.node_hours / sessions


def arrivals(load: Load) -> Iterator[tuple[float, float, float]]:
    """(arrival time, duration, device share) of each room, in order of arrival."""
    random = np.random.default_rng(load.seed)
    now_s = 0.0
    while (now_s := now_s + random.exponential(3600 / load.busiest_per_hour)) < DAY_S:
        stay_s, share = random.exponential(load.stay_s), load.share * random.lognormal(0.0, load.spread)
        if random.random() * max(HOURS) < HOURS[int(now_s // 3600)]:  # thinned from the busiest hour's rate
            yield now_s, stay_s, share


def simulate(policy: Policy, load: Load, fleet: Fleet) -> Day:
    """Simulate a day from midnight, starting with the nodes that an empty cluster needs."""
    cluster = _Cluster(policy, fleet)
    coming = deque(arrivals(load))
    total = len(coming)
    ticks = []
    for now_s in np.arange(0.0, DAY_S, TICK_S).tolist():
        while coming and coming[0][0] <= now_s:
            cluster.waiting.append(coming.popleft())
        ticks.append(cluster.tick(now_s))
    open_rooms, places, wanted, nodes, aged = np.array(ticks).T
    return Day(
        rooms=total,
        refused=cluster.refused,
        waited_s=tuple(cluster.waited_s),
        node_hours=float(nodes.sum()) * TICK_S / 3600,
        open_rooms=open_rooms,
        places=places,
        wanted=wanted,
        aged_share=float(aged.sum() / max(open_rooms.sum(), 1)),
    )


class _Cluster:
    """Simulation state."""

    def __init__(self, policy: Policy, fleet: Fleet) -> None:
        self._policy, self._fleet = policy, fleet
        self._capacity = Capacity(policy)
        self._nodes = [Node(0.0) for _ in range(_nodes_for(self._capacity.wanted(0.0, 0, 0.0), fleet))]
        self._leaving: list[tuple[float, int, Node]] = []
        self._numbers = count()
        self.waiting: list[tuple[float, float, float]] = []
        """Rooms that wait for a place, as from `arrivals`."""
        self.waited_s: list[float] = []
        self.refused = 0

    def tick(self, now_s: float) -> tuple[int, int, int, int, int]:
        """Open rooms, ready places, wanted places, paid nodes, rooms whose frames are too old."""
        while self._leaving and self._leaving[0][0] <= now_s:
            _, number, node = heapq.heappop(self._leaving)
            del node.rooms[number]
        self.waiting = [room for room in self.waiting if not self._settled(room, now_s)]
        ages = [(node.age_s(self._fleet.frame_s), len(node.rooms)) for node in self._nodes]
        rooms = sum(held for _, held in ages)
        mean_age_s = sum(age_s * held for age_s, held in ages) / max(rooms, 1)
        wanted = self._capacity.wanted(now_s, rooms + len(self.waiting), mean_age_s)
        self._nodes = _resized(self._nodes, _nodes_for(wanted, self._fleet), now_s, self._fleet)
        places = self._fleet.places * sum(node.ready_s <= now_s for node in self._nodes)
        aged = sum(held for age_s, held in ages if age_s > self._policy.queue_age_s)
        return rooms, places, wanted, len(self._nodes), aged

    def _settled(self, room: tuple[float, float, float], now_s: float) -> bool:
        """Whether the room has found a place or has stopped waiting."""
        came_s, stay_s, share = room
        free = [node for node in self._nodes if node.ready_s <= now_s and len(node.rooms) < self._fleet.places]
        if free:
            node, number = min(free, key=lambda one: len(one.rooms)), next(self._numbers)
            node.rooms[number] = share
            heapq.heappush(self._leaving, (now_s + stay_s, number, node))
            # A room that finds a place at the first tick after its arrival has not waited.
            self.waited_s.append(now_s - came_s if now_s - came_s >= TICK_S else 0.0)
            return True
        if now_s - came_s < self._fleet.patience_s:
            return False
        self.refused += 1
        return True


def _nodes_for(places: int, fleet: Fleet) -> int:
    return math.ceil(places / fleet.places)


def _resized(nodes: list[Node], wanted: int, now_s: float, fleet: Fleet) -> list[Node]:
    """Add nodes, which become ready later, or remove empty ones."""
    if len(nodes) < wanted:
        return nodes + [Node(now_s + fleet.start_s) for _ in range(wanted - len(nodes))]
    items_to_remove = len(nodes) - wanted
    gone = [node for node in reversed(nodes) if not node.rooms][:items_to_remove]
    return [node for node in nodes if not any(node is one for one in gone)]
