"""Twin of include/kept_shadows.clh: cells in plain integers, and a table of what is kept in them in float64."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from tests.reference.transfer_cache import cell_of, mixed
from tests.scenes.analytic import Floats

FACINGS = 5


def shadow_cell_of(
    position: Floats, normal: Floats, which: int, eye: Floats, spacing: float, places: int
) -> tuple[tuple[int, int], int]:
    """Key and place of the cell around a point of object `which`, -1 for real surface."""
    cell = cell_of(position, normal, eye, spacing, places)
    x, y, z = (int(v) + FACINGS // 2 for v in np.rint(normal * (FACINGS // 2)))
    own = 0 if which < 0 else 1 + ((which * FACINGS + z) * FACINGS + y) * FACINGS + x
    key = cell.key[0], cell.key[1] ^ mixed(own)
    return key, mixed(key[0] ^ mixed(key[1])) & (places - 1)


@dataclass
class Entry:
    """What is kept of one cell."""

    key: tuple[int, int]
    frame: int
    value: Floats
    lasts: int


@dataclass
class KeptTable:
    """One table; cells: key and place of each sample."""

    cells: list[tuple[tuple[int, int], int]]
    close: float
    longest: int
    entries: dict[int, Entry] = field(default_factory=dict)
    now: int = 0
    anew: int = 0
    """Samples of the last frame that were found anew."""

    def step(self, own: Floats, since: int, *, fills: bool = True) -> Floats:
        """[n, 3] what is shown in the next frame, in which samples would find `own`; since: see kept_shadows.py. fills:
        what is found is kept; else the frame is still to come."""
        self.now += 1
        shown, asked = own.copy(), dict[int, tuple[tuple[bool, int], Entry]]()
        self.anew = 0
        for i, (key, place) in enumerate(self.cells):
            entry = self.entries.get(place)
            entry = entry if entry is not None and entry.key == key else None
            is_true = entry is not None and entry.frame >= since
            is_other, lasts = False, 1 if entry is None else entry.lasts
            if entry is not None and is_true:
                if not self._is_due(entry, place):
                    shown[i] = entry.value
                    continue
                is_other = bool(np.abs(own[i] - entry.value).max() > self.close)
                shown[i] = own[i] if is_other else (own[i] + entry.value) / 2
                lasts = 1 if is_other else min(2 * entry.lasts, self.longest)
            self.anew += 1
            mine = (not is_other, i), Entry(key, self.now, shown[i], lasts)
            asked[place] = min(asked.get(place, mine), mine, key=lambda each: each[0])
        if fills:
            self.entries |= {place: entry for place, (_, entry) in asked.items()}
        else:
            self.now -= 1
        return shown

    def _is_due(self, entry: Entry, place: int) -> bool:
        if entry.lasts < self.longest:
            return self.now - entry.frame >= entry.lasts
        return place % self.longest == self.now % self.longest
