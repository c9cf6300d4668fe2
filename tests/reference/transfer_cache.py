"""Float64 twin of cl_kernels/transfer/transfer_cache.cl: a hash table of cells of the world, sample by sample."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

WAYS, FLAT, FACING = 2, 2.0, 0.8
BLOCK, ORDERS = 4, 16
NOT_STORED, LENT = -1, 1 << 30
NEW_ORDER = np.array([[0, 8, 2, 10], [12, 4, 14, 6], [3, 11, 1, 9], [15, 7, 13, 5]])
"""Of samples in a block of 4 x 4: the first four, the first eight and so on are each evenly spread."""
_MASK = 0xFFFFFFFF
_GOLDEN = 0x9E3779B9


def mixed(h: int) -> int:
    """A permutation of 32-bit numbers."""
    h ^= h >> 16
    h = h * 0x7FEB352D & _MASK
    h ^= h >> 15
    h = h * 0x846CA68B & _MASK
    return h ^ (h >> 16)


@dataclass(frozen=True)
class Cell:
    """The cell of the world around a point, for surface that faces one way."""

    key: tuple[int, int]
    side_m: float
    places: tuple[int, ...]
    margin: float
    """How far the point is from the next cell, in sides, and its distance from the next size of cells, in sizes."""


def cell_of(position: Floats, normal: Floats, eye: Floats, spacing: float, places: int) -> Cell:
    """Sides grow by factors of sqrt(2) with the distance between samples, which is `spacing` at one metre, and are
    sqrt(2) to 2 times as long."""
    size = 2 * np.log2(max(np.linalg.norm(position - eye) * spacing, 1e-4))
    level = int(np.ceil(size)) + 1
    side_m = 2.0 ** (level / 2)
    axis = int(np.abs(normal).argmax())
    sides = side_m * np.where(np.arange(3) == axis, FLAT, 1.0)
    at = position / sides
    x, y, z = (int(value) for value in np.floor(at))
    facing = 2 * axis + int(normal[axis] < 0)
    key = (x & 0xFFFFF) | facing << 20 | 1 << 23 | (level + 64) << 24, (y & 0xFFFF) | (z & 0xFFFF) << 16
    first = mixed(key[0] ^ mixed(key[1]))
    second = mixed((first + _GOLDEN) & _MASK)
    lengths = np.sort(np.abs(normal))
    margin = min(np.abs(at - np.rint(at)).min(), abs(size - np.rint(size)), lengths[2] - lengths[1], lengths[2])
    return Cell(key, side_m, (first & (places - 1), second & (places - 1)), float(margin))


@dataclass
class Entry:
    """What is kept of one cell."""

    key: tuple[int, int]
    traced: int
    used: int
    position: Floats
    normal: Floats
    value: float


def _is_of(entry: Entry | None, cell: Cell, point: Floats, normal: Floats) -> bool:
    """Whether it is of this cell, and of the same surface."""
    if entry is None or entry.key != cell.key:
        return False
    off_m = abs((entry.position - point) @ normal)
    return bool(off_m <= cell.side_m and entry.normal @ normal >= FACING)


@dataclass(frozen=True)
class Samples:
    """Those of a frame, row by row."""

    points: Floats
    """[n, 3]."""
    normals: Floats
    """[n, 3] unit."""
    valid: NDArray[np.bool_]
    """[n] whether there is surface."""
    cols: int
    eye: Floats
    spacing: float
    """Metres between samples one metre away."""

    def new_order(self, sample: int) -> int:
        """When a new sample is traced, among those of its block."""
        return int(NEW_ORDER[sample // self.cols % BLOCK, sample % self.cols % BLOCK])

    def around(self, sample: int) -> list[int]:
        """Samples with surface that are less than a block away."""
        row, col = divmod(sample, self.cols)
        rows = range(max(row - BLOCK + 1, 0), min(row + BLOCK, len(self.points) // self.cols))
        cols = range(max(col - BLOCK + 1, 0), min(col + BLOCK, self.cols))
        return [y * self.cols + x for y in rows for x in cols if self.valid[y * self.cols + x]]


@dataclass
class Table:
    """`entries` by place, for frames of samples that each have one value."""

    places: int
    period: int
    entries: dict[int, Entry] = field(default_factory=dict)

    def cell_of(self, samples: Samples, i: int) -> Cell:
        """Of one sample."""
        return cell_of(samples.points[i], samples.normals[i], samples.eye, samples.spacing, self.places)

    def choose(self, samples: Samples, now: int, most: int) -> NDArray[np.int64]:
        """[n] the place of an entry whose value a sample has; LENT + the sample whose value it takes; NOT_STORED or
        -2 - place where it is traced, which are `most` but for those that must be."""
        found = self._find(samples, now)
        new = [i for i in np.flatnonzero(samples.valid) if found[i] == NOT_STORED]
        orders = _orders_in([samples.new_order(i) for i in new], most)
        left = most - sum(samples.new_order(i) < orders for i in new)
        old = sorted({int(-2 - place) for place in found if place < NOT_STORED})
        old_orders = _orders_in([(place + now) % ORDERS for place in old], left)
        traced = {i for i in new if samples.new_order(i) < orders}
        kept = found.copy()
        for place in old if most < len(found) else ():
            first, *others = np.flatnonzero(found == -2 - place)
            kept[others] = place
            if (place + now) % ORDERS >= old_orders:
                kept[first] = place
        for i in new:
            lender = None if i in traced else self._lender_of(samples, i, found, traced)
            kept[i] = self._place_for(samples, i, now) if lender is None else LENT + lender
        return kept

    def store(self, samples: Samples, now: int, kept: NDArray[np.int64], values: Floats) -> NDArray[np.int64]:
        """Keep the `values` [n] of samples that were traced. Returns the places of all, NOT_STORED where there is
        none."""
        places = np.where(kept >= LENT, NOT_STORED, kept)
        claims: dict[int, int] = {}
        for i in np.flatnonzero(kept < NOT_STORED):
            claims.setdefault(int(-2 - kept[i]), int(i))
        places[kept < NOT_STORED] = NOT_STORED
        for place, i in claims.items():
            entry, cell, point, normal = (
                self.entries.get(place),
                self.cell_of(samples, i),
                samples.points[i],
                samples.normals[i],
            )
            is_known = _is_of(entry, cell, point, normal)
            earlier = 0 if is_known else mixed((cell.key[0] + cell.key[1]) & _MASK) % self.period
            self.entries[place] = Entry(cell.key, now - earlier, now, point, normal, float(values[i]))
            places[i] = place
        return places

    def _find(self, samples: Samples, now: int) -> NDArray[np.int64]:
        """[n] the place of each sample's entry, -2 - place where it is too old, NOT_STORED where there is none."""
        found = np.full(len(samples.points), NOT_STORED)
        for i in np.flatnonzero(samples.valid):
            cell = self.cell_of(samples, i)
            own = [p for p in cell.places if _is_of(self.entries.get(p), cell, samples.points[i], samples.normals[i])]
            if not own:
                continue
            entry = self.entries[own[0]]
            entry.used = now
            found[i] = own[0] if now - entry.traced < self.period else -2 - own[0]
        return found

    def _lender_of(self, samples: Samples, i: int, found: NDArray[np.int64], traced: set[int]) -> int | None:
        """The nearest sample around on the same surface that has a value; None: there is none."""
        side_m, best, nearest = self.cell_of(samples, i).side_m, None, np.inf
        for j in samples.around(i):
            offset = samples.points[j] - samples.points[i]
            has_value = found[j] != NOT_STORED or j in traced
            is_same = abs(offset @ samples.normals[i]) <= side_m and samples.normals[j] @ samples.normals[i] >= FACING
            if has_value and is_same and offset @ offset < nearest:
                best, nearest = j, float(offset @ offset)
        return best

    def _place_for(self, samples: Samples, i: int, now: int) -> int:
        """-2 - the place that a new sample asks for; NOT_STORED: all are in use."""
        places = self.cell_of(samples, i).places
        used = {place: self.entries[place].used if place in self.entries else 0 for place in places}
        idle = sorted((place for place in places if used[place] < now), key=lambda place: used[place])
        return -2 - idle[0] if idle else NOT_STORED


def _orders_in(orders: list[int], most: int) -> int:
    """How many orders are traced: as many as have `most` samples at most, and the first that has any."""
    counts = np.bincount(orders, minlength=ORDERS)
    sums = np.cumsum(counts)
    fits = (sums <= most) | (sums == counts)
    return int(ORDERS if fits.all() else fits.argmin())
