"""Which rooms the supervisor closes, so that their places are free for others."""

from __future__ import annotations

from collections.abc import Mapping

from server.cluster.host import HostStatus

FIRST_CLIENT_S = 30.0
"""An open room whose client has not come for so long is given up: it left while its room was being opened."""


def rooms_to_close(rooms: Mapping[str, HostStatus | None], close_after_s: float, *, is_full: bool) -> list[str]:
    """Names of empty rooms to close. `rooms`: status by name; None: waits for a place, starts, moves or is closing.

    A private room is closed as soon as its session has ended, since nobody can come back to it. Another one is closed
    after `close_after_s`, and before that if the cluster `is_full` and rooms wait: those that are empty longest first.
    """
    empty = {name: status for name, status in rooms.items() if status is not None and status.clients == 0}
    due = [name for name, status in empty.items() if status.idle_s > _patience_s(status, close_after_s)]
    waiting = sum(status is None for status in rooms.values()) if is_full else 0
    spare = sorted(
        (name for name, status in empty.items() if name not in due and not status.is_new),
        key=lambda name: -empty[name].idle_s,
    )
    return due + spare[: max(0, waiting - len(due))]


def _patience_s(status: HostStatus, close_after_s: float) -> float:
    if status.is_new:
        return max(FIRST_CLIENT_S, 0.0 if status.is_private else close_after_s)
    return 0.0 if status.is_private else close_after_s


def is_enough(free: Mapping[str, float], place: Mapping[str, float]) -> bool:
    """Whether a place fits into what is free in all; it may be spread over nodes."""
    return all(free.get(kind, 0.0) >= share for kind, share in place.items())
