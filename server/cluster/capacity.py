"""Autoscaling policy: how many rooms the cluster should have places for. Shared by supervisor and simulation."""

from __future__ import annotations

import math
from collections import deque
from typing import Annotated

from msgspec import Meta, Struct


class Policy(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """The autoscaler's settings."""

    spare: Annotated[int, Meta(ge=0)] = 2
    """Places kept free, so that a new room does not wait for a machine to start."""
    spare_share: Annotated[float, Meta(ge=0, le=4)] = 0.1
    """The same as a share of the open rooms; the larger of the two counts."""
    queue_age_s: Annotated[float, Meta(gt=0)] = 0.25
    """Mean queue age of frames over all rooms above which nodes are considered overloaded."""
    most_relief: Annotated[float, Meta(ge=1, le=4)] = 1.5
    """Limit on the factor by which overload increases the places. Open rooms are not moved."""
    shrink_after_s: Annotated[float, Meta(ge=0)] = 600.0
    """Places are released after they have not been needed for this time."""
    most: Annotated[int, Meta(ge=1)] = 64
    """Upper limit on the places requested."""


class Capacity:
    """Scales up at once and down after a delay."""

    def __init__(self, policy: Policy) -> None:
        self._policy = policy
        self._needs: deque[tuple[float, int]] = deque()
        """(time, places needed), decreasing in places: a sliding-window maximum."""

    def wanted(self, now_s: float, rooms: int, queue_age_s: float) -> int:
        """Total places, including used ones. `rooms`: open or being opened. `now_s` must not decrease."""
        need = places_needed(self._policy, rooms, queue_age_s)
        while self._needs and self._needs[-1][1] <= need:
            self._needs.pop()
        self._needs.append((now_s, need))
        while now_s - self._needs[0][0] > self._policy.shrink_after_s:
            self._needs.popleft()
        return self._needs[0][1]


def places_needed(policy: Policy, rooms: int, queue_age_s: float) -> int:
    """Places needed now."""
    relief = min(max(queue_age_s / policy.queue_age_s, 1.0), policy.most_relief)
    spare = max(policy.spare, math.ceil(policy.spare_share * rooms))
    return min(math.ceil(rooms * relief) + spare, policy.most)
