"""How many places for rooms the cluster should have. Pure: the keeper and the simulation ask the same."""

from __future__ import annotations

import math
from collections import deque
from typing import Annotated

from msgspec import Meta, Struct


class Policy(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """The autoscaler's settings."""

    spare: Annotated[int, Meta(ge=0)] = 2
    """Places kept free, so that a room need not wait for a machine to start."""
    spare_share: Annotated[float, Meta(ge=0, le=4)] = 0.1
    """The same as a share of the rooms that are open, where that is more."""
    queue_age_s: Annotated[float, Meta(gt=0)] = 0.25
    """Of frames, in the mean over all rooms; when it is longer, nodes hold too many rooms."""
    most_relief: Annotated[float, Meta(ge=1, le=4)] = 1.5
    """By how much at most a queue age beyond that adds places: rooms that are open stay where they are."""
    shrink_after_s: Annotated[float, Meta(ge=0)] = 600.0
    """Places are given back when they have not been wanted for so long."""
    most: Annotated[int, Meta(ge=1)] = 64
    """Places that are asked for, whatever comes."""


class Capacity:
    """Up at once, down after a while."""

    def __init__(self, policy: Policy) -> None:
        self._policy = policy
        self._needs: deque[tuple[float, int]] = deque()
        """When and how many places were needed, only those that no later one reaches."""

    def wanted(self, now_s: float, rooms: int, queue_age_s: float) -> int:
        """Places in all, those that are taken included. `rooms`: open or being opened. Times must not go back."""
        need = places_needed(self._policy, rooms, queue_age_s)
        while self._needs and self._needs[-1][1] <= need:
            self._needs.pop()
        self._needs.append((now_s, need))
        while now_s - self._needs[0][0] > self._policy.shrink_after_s:
            self._needs.popleft()
        return self._needs[0][1]


def places_needed(policy: Policy, rooms: int, queue_age_s: float) -> int:
    """At this moment."""
    relief = min(max(queue_age_s / policy.queue_age_s, 1.0), policy.most_relief)
    spare = max(policy.spare, math.ceil(policy.spare_share * rooms))
    return min(math.ceil(rooms * relief) + spare, policy.most)
