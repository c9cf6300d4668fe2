"""A day's load played against the autoscaler's settings: who waits, what it costs. Pure, seconds for a day.

Rooms arrive as a Poisson process whose rate follows the hour and stay for exponential times; nodes take a while to
start and leave when they are empty and more than what is wanted; a room goes to the node that holds fewest of them, and
stays there. Each room asks for its own share of a node's device; where a node's rooms ask for more than there is, their
frames age.
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
"""Between two looks of the keeper at the whole."""
HOURS = (2, 1, 1, 1, 1, 2, 4, 8, 14, 20, 22, 24, 26, 24, 24, 26, 32, 44, 66, 88, 100, 82, 42, 12)
"""Rooms that open in each hour, as parts of the busiest one's: an assumption, of a service that is used after work."""


@dataclass(frozen=True)
class Load:
    """Of one day."""

    busiest_per_hour: float = 120.0
    """Rooms that open in the busiest hour."""
    stay_s: float = 1200.0
    """Mean."""
    share: float = 0.2
    """Of a node's device that a room asks for, in the mean."""
    spread: float = 0.5
    """Standard deviation of the logarithm of that."""
    seed: int = 1


@dataclass(frozen=True)
class Fleet:
    """The machines."""

    places: int = 4
    """Rooms that a node takes."""
    start_s: float = 150.0
    """From asking for a node to its first room."""
    patience_s: float = 20.0
    """For which a client waits for its room."""
    frame_s: float = 0.1
    """Age of frames where a node has time for all."""


@dataclass
class Node:
    """One machine."""

    ready_s: float
    rooms: dict[int, float] = field(default_factory=dict)
    """Share of the device that each asks for."""

    def age_s(self, frame_s: float) -> float:
        """Of its frames when they are taken."""
        return frame_s * max(1.0, sum(self.rooms.values()))


@dataclass(frozen=True)
class Day:
    """What came out; the series have a value a tick."""

    rooms: int
    """That came."""
    refused: int
    """After their patience."""
    waited_s: tuple[float, ...]
    """Of each that was let in."""
    node_hours: float
    open_rooms: NDArray[np.int64]
    places: NDArray[np.int64]
    wanted: NDArray[np.int64]
    aged_share: float
    """Of all time that rooms were open, with frames older than the policy's."""

    @property
    def refused_share(self) -> float:
        """Of all that came."""
        return self.refused / max(self.rooms, 1)

    @property
    def used_share(self) -> float:
        """Of all places that were there, over the day."""
        return float(self.open_rooms.sum() / max(self.places.sum(), 1))

    def cost_per_thousand(self, price_per_node_hour: float, sessions_per_room: float) -> float:
        """Of sessions, in the price's currency."""
        sessions = (self.rooms - self.refused) * sessions_per_room
        return 1000 * price_per_node_hour * self.node_hours / sessions


def arrivals(load: Load) -> Iterator[tuple[float, float, float]]:
    """When each room comes, how long it stays and what it asks for; in order of time."""
    random = np.random.default_rng(load.seed)
    now_s = 0.0
    while (now_s := now_s + random.exponential(3600 / load.busiest_per_hour)) < DAY_S:
        stay_s, share = random.exponential(load.stay_s), load.share * random.lognormal(0.0, load.spread)
        if random.random() * max(HOURS) < HOURS[int(now_s // 3600)]:  # thinned from the busiest hour's rate
            yield now_s, stay_s, share


def simulate(policy: Policy, load: Load, fleet: Fleet) -> Day:
    """Play a day from midnight, beginning with as many nodes as an empty cluster wants."""
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
    """While the day goes on."""

    def __init__(self, policy: Policy, fleet: Fleet) -> None:
        self._policy, self._fleet = policy, fleet
        self._capacity = Capacity(policy)
        self._nodes = [Node(0.0) for _ in range(_nodes_for(self._capacity.wanted(0.0, 0, 0.0), fleet))]
        self._leaving: list[tuple[float, int, Node]] = []
        self._numbers = count()
        self.waiting: list[tuple[float, float, float]] = []
        """As they arrive."""
        self.waited_s: list[float] = []
        self.refused = 0

    def tick(self, now_s: float) -> tuple[int, int, int, int, int]:
        """Rooms that are open, places ready, places wanted, nodes paid for, rooms whose frames are too old."""
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
        """Whether it has found a place, or waits no longer."""
        came_s, stay_s, share = room
        free = [node for node in self._nodes if node.ready_s <= now_s and len(node.rooms) < self._fleet.places]
        if free:
            node, number = min(free, key=lambda one: len(one.rooms)), next(self._numbers)
            node.rooms[number] = share
            heapq.heappush(self._leaving, (now_s + stay_s, number, node))
            # One that comes between two ticks and finds a place at the next has not waited.
            self.waited_s.append(now_s - came_s if now_s - came_s >= TICK_S else 0.0)
            return True
        if now_s - came_s < self._fleet.patience_s:
            return False
        self.refused += 1
        return True


def _nodes_for(places: int, fleet: Fleet) -> int:
    return math.ceil(places / fleet.places)


def _resized(nodes: list[Node], wanted: int, now_s: float, fleet: Fleet) -> list[Node]:
    """More nodes at once, to be ready later; fewer only by those that are empty."""
    if len(nodes) < wanted:
        return nodes + [Node(now_s + fleet.start_s) for _ in range(wanted - len(nodes))]
    surplus = len(nodes) - wanted
    gone = [node for node in reversed(nodes) if not node.rooms][:surplus]
    return [node for node in nodes if not any(node is one for one in gone)]
