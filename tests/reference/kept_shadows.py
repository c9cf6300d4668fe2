"""Twin of include/kept_shadows.clh: cells in plain integers, and a table of what is kept in them in float64."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

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
    lasts: float
    """Less than 1: found with another sample's transfer."""


@dataclass
class KeptTable:
    """One table; cells: key and place of each sample."""

    cells: list[tuple[tuple[int, int], int]]
    close: float
    longest: int
    open_: Floats | float = 1.0
    """[n, 3] what samples show where nothing is taken from them. Values are what is left of it, or, with `takes`, what
    is taken."""
    takes: bool = False
    entries: dict[int, Entry] = field(default_factory=dict)
    now: int = 0
    anew: int = 0
    """Samples of the last frame that were found anew."""
    stands: int = 0
    """Those that show what is kept."""
    lent: int = 0
    """Those of the others that have the transfer of others."""
    changes: dict[bool, list[float]] = field(default_factory=dict)
    """Codes by which what the frame before showed was off; by whether it was lent."""

    def step(
        self,
        own: Floats,
        since: int,
        *,
        fills: bool = True,
        lent: NDArray[np.bool_] | None = None,
        traced: NDArray[np.bool_] | None = None,
    ) -> Floats:
        """[n, 3] what is shown in the next frame, in which samples would find `own`; since: see kept_shadows.py. fills:
        what is found is kept; else the frame is still to come. lent: [n] samples with the transfer of others; traced:
        those whose own was traced in this frame."""
        self.now += 1
        self.stands = self.lent = 0
        self.changes = {False: [], True: []}
        are_lent, are_traced = (np.zeros(len(own), bool) if each is None else each for each in (lent, traced))
        shown, asked = own.copy(), dict[int, tuple[tuple[bool, bool, int], Entry]]()
        self.anew = 0
        for i, (key, place) in enumerate(self.cells):
            entry = self.entries.get(place)
            entry = entry if entry is not None and entry.key == key else None
            is_true = entry is not None and entry.frame >= since
            is_other, is_lent = False, bool(are_lent[i])
            lasts = 1.0 if entry is None else max(entry.lasts, 1.0)
            if entry is not None and is_true:
                if not (are_traced[i] or self._is_due(entry, place)):
                    shown[i] = entry.value
                    self.stands += 1
                    continue
                if not is_lent and not 1 <= entry.lasts < 2:
                    self.changes[entry.lasts < 1].append(self._codes_apart(i, own[i], entry.value))
                is_other = bool(np.abs(own[i] - entry.value).max() > self.close)
                shown[i] = own[i] if is_other else (own[i] + entry.value) / 2
                lasts = 1.0 if is_other else max(1.0, min(2 * entry.lasts, self.longest))
            self.anew += 1
            self.lent += is_lent
            mine = (is_lent, not is_other, i), Entry(key, self.now, shown[i], 0.5 if is_lent else lasts)
            asked[place] = min(asked.get(place, mine), mine, key=lambda each: each[0])
        if fills:
            self.entries |= {place: entry for place, (_, entry) in asked.items()}
        else:
            self.now -= 1
        return shown

    def _is_due(self, entry: Entry, place: int) -> bool:
        if entry.lasts < self.longest:
            return self.now - entry.frame >= int(entry.lasts)
        return place % self.longest == self.now % self.longest

    def _codes_apart(self, i: int, now: Floats, before: Floats) -> float:
        """Greatest change of an sRGB code, of white that shows all of `open_`."""
        whole = np.broadcast_to(self.open_, (len(self.cells), 3))[i]
        a, b = (whole - now, whole - before) if self.takes else (now, before)
        white = np.maximum(np.maximum(a, b), whole)
        encoded = (255 * 1.055 * (np.maximum(x, 0) / white) ** (1 / 2.4) for x in (a, b))
        return float(np.abs(np.subtract(*encoded)).max())
