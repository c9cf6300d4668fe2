"""Selects the frames that light is estimated from: recent ones, and earlier ones that show other surfaces.

A camera that turns away loses no information; frames that show the same surfaces count once. Surfaces shared with the
newest frame show whether the light has changed since (light_change.py): frames under another light lose their weight.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from server.light.cell_transfer import Pools
from server.light.light_model import Frame
from server.maths.light_change import Shot, Shown, change_between, shown_by, surface_cells
from server.maths.sh import LUMINANCE

RECENT = 5
"""Last frames that are kept."""
KEPT = 6
"""Earlier ones that are."""
SLOTS = RECENT + KEPT + 1
"""One is free for the next frame."""
NEW_SHARE = 0.25
"""Of the surface of a frame, which no frame kept shows: such a frame is kept."""
_AREA_M = 0.25  # cells of surface that frames are compared by
_FORGOTTEN = 1e-3  # of its weight: a frame that is left out
Cells = NDArray[np.int64]


@dataclass
class _Entry:
    frame: Frame
    number: int
    areas: Cells
    """[k] distinct cells of surface that it shows."""
    shown: Shown


@dataclass(frozen=True)
class Contradiction:
    """Evidence of the newest frame against earlier ones."""

    frames_ago: int
    """The youngest frame under another light, 0: none."""
    is_told: bool
    """Whether it shares surface with any."""


class FrameWindow:
    """The frames of one session's estimate, by slot."""

    def __init__(self, count: int = 0) -> None:
        """`count`: frames before."""
        self._entries: dict[int, _Entry] = {}
        self._recent: list[int] = []
        self._kept: list[int] = []
        self._count = count

    @property
    def frames(self) -> dict[int, Frame]:
        """Those that count."""
        return {slot: entry.frame for slot, entry in self._entries.items()}

    @property
    def count(self) -> int:
        """Frames so far."""
        return self._count

    def free_slot(self) -> int:
        """For the next frame."""
        return next(slot for slot in range(SLOTS) if slot not in self._entries)

    def add(self, slot: int, frame: Frame, shot: Shot) -> None:
        """Take the next frame in; the one that is least needed goes."""
        self._count += 1
        pools = frame.pools
        used = pools.weights > 0
        areas = np.unique(surface_cells(pools.positions[used], pools.normals[used], _AREA_M))
        self._entries[slot] = _Entry(frame, self._count, areas, _shown_in(pools, shot))
        self._recent.append(slot)
        if len(self._recent) > RECENT:
            self._retire(self._recent.pop(0))

    def weigh(self, newest: int) -> Contradiction:
        """Take weight from frames under another light than that in slot `newest`, and from all before them.

        A change just above the least leaves a third, a greater one hardly anything.
        """
        now = self._entries[newest]
        changes = {
            slot: change_between(entry.shown, now.shown) for slot, entry in self._entries.items() if slot != newest
        }
        certain = {self._entries[slot].number: change for slot, change in changes.items() if change.is_certain}
        if not certain:
            return Contradiction(0, any(change.evidence > 0 for change in changes.values()))
        youngest = max(certain)
        for entry in self._entries.values():
            if entry.number <= youngest:
                entry.frame.keep *= certain.get(entry.number, certain[youngest]).kept_weight
        self._leave_out()
        return Contradiction(now.number - youngest, is_told=True)

    def forget(self, newest: int, factor: float) -> None:
        """Leave all frames but one so much of their weight."""
        for slot, entry in self._entries.items():
            if slot != newest:
                entry.frame.keep *= factor
        self._leave_out()

    def _retire(self, slot: int) -> None:
        """Keep a frame that is no longer among the last, if it shows what no other kept frame does."""
        areas = self._entries[slot].areas
        if np.isin(areas, self._areas(self._kept), invert=True).mean() < NEW_SHARE:
            del self._entries[slot]
            return
        self._kept.append(slot)
        if len(self._kept) > KEPT:
            alone = [
                np.isin(self._entries[k].areas, self._areas([s for s in self._entries if s != k]), invert=True).sum()
                for k in self._kept
            ]
            del self._entries[self._kept.pop(int(np.argmin(alone)))]

    def _areas(self, slots: list[int]) -> Cells:
        return np.concatenate([np.zeros(0, np.int64), *(self._entries[slot].areas for slot in slots)])

    def _leave_out(self) -> None:
        """Frames of no weight give their slots back."""
        for slots in (self._recent, self._kept):
            for slot in [s for s in slots if self._entries[s].frame.keep < _FORGOTTEN]:
                slots.remove(slot)
                del self._entries[slot]


def _shown_in(pools: Pools, shot: Shot) -> Shown:
    luminance = np.asarray(pools.seen @ LUMINANCE)
    return shown_by(luminance, pools.weights, pools.positions, pools.normals, shot)
