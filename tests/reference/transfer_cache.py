"""Float64 twin of cl_kernels/transfer/transfer_cache.cl: a hash table of cells of the world, sample by sample."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

WAYS, FLAT, FACING = 2, 2.0, 0.8
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
    lasts: int
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


@dataclass
class Table:
    """`entries` by place, for frames of samples that each have one value."""

    places: int
    period: int
    longest: int
    entries: dict[int, Entry] = field(default_factory=dict)

    def find(
        self, points: Floats, normals: Floats, valid: NDArray[np.bool_], eye: Floats, spacing: float, now: int
    ) -> NDArray[np.int64]:
        """[n] the place of each sample's entry, -1 where there is none that holds; points, normals [n, 3]."""
        found = np.full(len(points), -1)
        for i in np.flatnonzero(valid):
            cell = cell_of(points[i], normals[i], eye, spacing, self.places)
            for place in cell.places:
                if not _is_of(self.entries.get(place), cell, points[i], normals[i]):
                    continue
                entry = self.entries[place]
                if now - entry.traced < entry.lasts:
                    entry.used, found[i] = now, place
                break
        return found

    def store(
        self,
        points: Floats,
        normals: Floats,
        valid: NDArray[np.bool_],
        eye: Floats,
        spacing: float,
        now: int,
        found: NDArray[np.int64],
        values: Floats,
    ) -> NDArray[np.int64]:
        """Keep the `values` [n] of samples that were not found. Returns the places of all, -1 where there is none."""
        claims: dict[int, tuple[int, Cell]] = {}
        for i in np.flatnonzero(valid & (found < 0)):
            cell = cell_of(points[i], normals[i], eye, spacing, self.places)
            own = [place for place in cell.places if _is_of(self.entries.get(place), cell, points[i], normals[i])]
            used = {place: self.entries[place].used if place in self.entries else 0 for place in cell.places}
            idle = sorted((place for place in cell.places if used[place] < now), key=lambda place: used[place])
            if own or idle:
                claims.setdefault((own or idle)[0], (int(i), cell))
        places = found.copy()
        for place, (i, cell) in claims.items():
            entry = self.entries.get(place)
            is_known = _is_of(entry, cell, points[i], normals[i])
            lasts = min(2 * entry.lasts, self.longest) if entry is not None and is_known else self.period
            earlier = 0 if is_known else mixed((cell.key[0] + cell.key[1]) & _MASK) % self.period
            self.entries[place] = Entry(cell.key, now - earlier, lasts, now, points[i], normals[i], float(values[i]))
            places[i] = place
        return places
