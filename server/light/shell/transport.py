"""How radiance travels in a room: from which unknown cells a patch receives light, and what it is known to receive.

Unknown cells are those of the shell, what saturated surface sends beyond what the picture could show, lamps that no
picture has shown, and surface that was met from its back or without a colour. Scanned surface sends what the camera saw
it send; where it was seen under another light only, the shell behind it does.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_matrix

from server.light.shell.emitters import Emitters, EmittersSeen, keys_of
from server.light.shell.patches import MOST_PATCHES, RAYS, Patches, hemisphere_weights, ray_directions
from server.light.shell.shell import CELLS, CORNERS, FLOOR, SIDE, SIDES, Shell
from server.maths.lobes import LOBES, lobes_along

HIDDEN_M = 0.6
"""Side of the cells of hidden surface: a piece of furniture. Those of saturated surface are smaller (CELL_M)."""
MOST_HIDDEN, MOST_SATURATED, MOST_LAMPS = 128, 96, 2
"""Most cells of each kind. Surface beyond that shares one more cell of its kind: what is hidden must not send as a lamp
does. Furnished rooms have up to 110 and 55 in a second, the real kitchen 60 and 55 in four."""
SATURATED, ALL_CHANNELS = 0.97, 0.9
"""Radiance of the strongest channel from which a picture's values are lower bounds, code 252 of 255, and the share of
it that the weakest has then: where another channel is not clipped, the surface is hardly brighter than it looks."""
COLUMNS = CELLS + MOST_HIDDEN + 1 + MOST_SATURATED + 1 + MOST_LAMPS
KNOWN, NO_CELL = -1, -2
"""Values in place of a cell: KNOWN is photographed surface; NO_CELL is hidden or saturated surface from which no patch
has received light."""
NEAR_SIDES = 2 / 3
"""Surface within so many sides of a patch is near it: of PATCH_M, .1 m."""
HIDDEN, BRIGHT, LAMP = range(3)
"""Kinds of keys, modulo 3: of hidden and saturated surface, and of lamps that were not seen."""
SHARED = -3, -2
"""Keys of the cells that hidden and saturated surface share."""
_MOST = MOST_HIDDEN, MOST_SATURATED, MOST_LAMPS
_MIDDLE = 1 << 19  # half the cells along an axis: 150 km
_AT_ONCE = 64  # patches whose rays are worked on together: 32 768 rays, some MB
_MOST_COUNTED = 1e4  # rays that the mean of a saturated cell remembers

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]


@dataclass(frozen=True)
class Met:
    """What rays meet."""

    columns: Ints
    """[..., CORNERS] the unknown cells; all of them KNOWN or NO_CELL."""
    shares: Floats
    """[..., CORNERS] of them, with sum 1 or, where KNOWN, 0."""
    known: NDArray[np.floating]
    """[..., 3] radiance of photographed surface, 0 elsewhere."""
    is_saturated: NDArray[np.bool_]
    """[...] whether that is a lower bound: the cell's is added to it."""
    distances: NDArray[np.floating]
    """[...] metres; 0 where no surface is met."""


class Transport:
    """Shares of the unknown cells, for all patches."""

    def __init__(self) -> None:
        self.shares: NDArray[np.float32] = np.zeros((MOST_PATCHES, COLUMNS), np.float32)
        """[patches, COLUMNS] share of a patch's cosine-weighted rays that end in each cell."""
        self._by_rays: NDArray[np.float32] = np.zeros((MOST_PATCHES, COLUMNS), np.float32)  # less saturated cells
        self.beyond: NDArray[np.float32] = np.zeros((MOST_PATCHES, SIDES, LOBES), np.float32)
        """[patches, SIDES, LOBES] what white surface would show of distant lobes, by the side of the shell they come
        in at."""
        self.known: Floats = np.zeros((MOST_PATCHES, 3))
        """[patches, 3] radiance that known surface brings."""
        self.near: Floats = np.zeros(MOST_PATCHES)
        """[patches] share of a patch's cosine-weighted rays that end on surface near it."""
        self.floor: NDArray[np.float32] = np.zeros((SIDE * SIDE, CELLS), np.float32)
        """[SIDE^2, CELLS] share of the shell's cells of the cosine-weighted hemispheres of those of its floor, with
        nothing in between."""
        self.is_saturated = np.zeros(COLUMNS, bool)
        self.is_lamp = np.zeros(COLUMNS, bool)
        """[COLUMNS] lamps that no picture has shown; `is_saturated` too, since they are as bright at least."""
        self.clipped: Floats = np.zeros((COLUMNS, 3))
        """[COLUMNS, 3] mean radiance of saturated cells as pictures show it."""
        self.lit: Floats = np.ones(COLUMNS)
        """[COLUMNS] from 0 to 1: how far the light that arrives there explains that it is saturated."""
        self._counts = np.zeros(COLUMNS)
        self.hidden: dict[int, int] = {}
        """Columns of the cells of hidden and of saturated surface, by their keys."""
        self._bright_rows, self._bright_shares = np.zeros(0, np.int64), np.zeros(0)
        self._bright_ends = np.zeros((0, 3))
        """Rays that meet saturated surface: whose they are, how far they count, and where they end."""
        self._shell: Shell | None = None

    @property
    def columns(self) -> int:
        """Cells that exist."""
        return CELLS + len(self.hidden)

    def update(self, patches: Patches, bright: EmittersSeen, traced: Ints, shell: Shell) -> None:
        """Fold in the patches whose rays were traced; all patches, where the shell has changed."""
        rows = traced
        if shell is not self._shell:
            self._shell, rows, self.floor = shell, patches.used, floor_shares(shell)
        for first in range(0, len(rows), _AT_ONCE):
            self._update_rays(patches, rows[first : first + _AT_ONCE], shell)
        if len(patches.used):
            self._update_emitters(patches, bright, patches.used, shell)

    def _update_rays(self, patches: Patches, rows: Ints, shell: Shell) -> None:
        """What evenly spread rays meet, but for saturated surface."""
        # np.take: four times as fast as an index.
        weights, positions = hemisphere_weights(patches.traced_normals[rows]), patches.positions[rows]
        met = patches.arrivals[rows].reshape(-1, 4)
        above = np.flatnonzero(weights)
        distances = np.take(met[:, 3], above)
        is_free, behind = distances == 0, np.flatnonzero(distances < 0)
        is_free[behind] = _of_another_light(np.take(met, above[behind], axis=0))
        row, ray, share = _of_rays(weights, above[is_free])
        columns, corners = shell.exits(np.take(positions, row, axis=0), np.take(ray_directions(), ray, axis=0))
        sums = _summed(row, columns, corners * share[:, None], len(rows))
        nothing_met = distances[is_free] == 0
        self.beyond[rows] = _beyond(row, ray, share * nothing_met, columns[:, 0], len(rows))
        row, ray, share = _of_rays(weights, above[~is_free])
        arrivals = np.take(met, above[~is_free], axis=0).astype(np.float64)
        ends = np.take(positions, row, axis=0) + np.abs(arrivals[:, 3:]) * np.take(ray_directions(), ray, axis=0)
        back, bright = arrivals[:, 3] < 0, _is_bright(arrivals)
        keys = _back_keys(ends[back])
        self._add_cells(keys, HIDDEN)
        np.add.at(sums.reshape(-1), COLUMNS * row[back] + columns_of(self.hidden, keys), share[back])
        self._by_rays[rows] = sums
        keys = bright_keys(ends[bright])
        self._add_cells(keys, BRIGHT)
        self._note_clipped(columns_of(self.hidden, keys), arrivals[bright, :3])
        self._note_bright(rows, rows[row[bright]], share[bright], ends[bright])
        is_near = np.abs(arrivals[:, 3]) < NEAR_SIDES * patches.side_m
        self.near[rows] = np.bincount(row, share * is_near, len(rows))
        brought = share * ~back
        self.known[rows] = np.stack([np.bincount(row, brought * c, len(rows)) for c in arrivals[:, :3].T], axis=1)

    def _note_bright(self, rows: Ints, row: Ints, shares: Floats, ends: Floats) -> None:
        """Keep which rays [m] of patches `row` [m], now of all in `rows`, meet saturated surface, and where."""
        others = ~np.isin(self._bright_rows, rows)
        self._bright_rows = np.concatenate([self._bright_rows[others], row])
        self._bright_shares = np.concatenate([self._bright_shares[others], shares])
        self._bright_ends = np.concatenate([self._bright_ends[others], ends])

    def _update_emitters(self, patches: Patches, bright: EmittersSeen, rows: Ints, shell: Shell) -> None:
        """Saturated surface: each emitter by a ray of its own, what is large or no emitter by evenly spread rays."""
        emitters = bright.emitters
        keys = emitter_keys(emitters)
        self._add_cells(keys[~emitters.is_unseen], BRIGHT)
        self._add_cells(keys[emitters.is_unseen], LAMP)
        columns = columns_of(self.hidden, keys)
        self._note_clipped(columns, emitters.radiance)
        self.lit[columns] = emitters.lit_by(patches, shell.axes[2])
        shares = emitters.shares(patches.positions[rows], patches.normals[rows])
        weights = emitters.weights(shares, RAYS // 2)
        sums = self._by_rays[rows]
        for column, brought in zip(columns, (weights * shares * bright.visible[rows]).T, strict=True):
            sums[:, column] += brought  # several may share the last one
        row = np.searchsorted(rows, self._bright_rows)
        is_used = rows[np.minimum(row, len(rows) - 1)] == self._bright_rows
        row, ends, ray_shares = row[is_used], self._bright_ends[is_used], self._bright_shares[is_used]
        counts = emitters.left_to_others(weights, row, ends)
        np.add.at(sums.reshape(-1), COLUMNS * row + columns_of(self.hidden, bright_keys(ends)), counts * ray_shares)
        self.shares[rows] = sums

    def _add_cells(self, keys: Ints, kind: int) -> None:
        of_kind = sum(key % 3 == kind for key in self.hidden)
        for key in sorted(set(keys.tolist()) - self.hidden.keys()):
            number = key if of_kind < _MOST[kind] else SHARED[kind]
            if number not in self.hidden:
                self.is_saturated[self.columns] = kind != HIDDEN
                self.is_lamp[self.columns] = kind == LAMP
                self.hidden[number] = self.columns
                of_kind += 1

    def _note_clipped(self, columns: Ints, radiance: Floats) -> None:
        """Fold in the clipped `radiance` [n, 3] of saturated cells `columns` [n]."""
        counts = np.bincount(columns, minlength=COLUMNS).astype(np.float64)
        sums = np.stack([np.bincount(columns, channel, COLUMNS) for channel in radiance.T], axis=1)
        total = self._counts + counts
        share = np.where(total > 0, counts / np.maximum(total, 1.0), 0.0)[:, None]
        self.clipped += share * (sums / np.maximum(counts, 1.0)[:, None] - self.clipped)
        self._counts = np.minimum(total, _MOST_COUNTED)


def _of_rays(weights: Floats, chosen: Ints) -> tuple[Ints, Ints, Floats]:
    """[m] patch and direction, and how far it counts, of `chosen` [m] places in `weights` [patches, RAYS]."""
    row = chosen // RAYS
    return row, chosen - RAYS * row, np.take(weights, chosen)


def _summed(rows: Ints, columns: Ints, shares: Floats, count: int) -> Floats:
    """[count, COLUMNS] sums over rays of `shares` of `columns`, [m, CORNERS] each; rows [m]: whose they are."""
    place = COLUMNS * rows[:, None] + columns
    sums = np.bincount(place.ravel(), shares.ravel(), count * COLUMNS)
    return np.asarray(sums.reshape(-1, COLUMNS), np.float64)


def floor_shares(shell: Shell) -> NDArray[np.float32]:
    """As of Transport.floor."""
    weights = hemisphere_weights(shell.axes[2:])[0]
    rays = np.flatnonzero(weights)
    row = np.repeat(np.arange(SIDE * SIDE), len(rays))
    origins, directions = (shell.centers[FLOOR] @ shell.axes)[row], ray_directions()[np.tile(rays, SIDE * SIDE)]
    columns, corners = shell.exits(origins, directions)
    sums = _summed(row, columns, corners * np.tile(weights[rays], SIDE * SIDE)[:, None], SIDE * SIDE)
    return sums[:, :CELLS].astype(np.float32)


def _back_keys(points: Floats) -> Ints:
    """[n] keys of the cells of hidden surface at points [n, 3]."""
    return np.asarray(3 * _cell_numbers(np.floor(points / HIDDEN_M)) + HIDDEN)


def bright_keys(points: Floats) -> Ints:
    """[n] keys of the cells of saturated surface at points [n, 3]."""
    return np.asarray(3 * _cell_numbers(keys_of(points)) + BRIGHT)


def lamp_keys(numbers: Sequence[int]) -> Ints:
    """[k] keys of lamps that were not seen, by their numbers."""
    cells = np.zeros((len(numbers), 3), np.int64)
    cells[:, 0] = numbers
    return np.asarray(3 * _cell_numbers(cells) + LAMP)


def emitter_keys(emitters: Emitters) -> Ints:
    """[k] keys of the emitters' cells."""
    return np.asarray(3 * _cell_numbers(emitters.keys) + np.where(emitters.is_unseen, LAMP, BRIGHT))


def meet(
    shell: Shell, hidden: Mapping[int, int], origins: Floats, directions: Floats, arrivals: NDArray[np.floating]
) -> Met:
    """What rays from `origins` [n, 3] (world) along `directions` [n, m, 3] meet; arrivals [n, m, 4] as traced.

    hidden: as of Transport.
    """
    distance, is_bright, is_back = arrivals[..., 3], _is_bright(arrivals), _is_back(arrivals)
    is_free = (distance <= 0) & ~is_back
    columns = np.full((*distance.shape, CORNERS), KNOWN, np.int64)
    shares = np.zeros((*distance.shape, CORNERS))
    place, ray = np.nonzero(is_free)
    columns[place, ray], shares[place, ray] = shell.exits(origins[place], directions[place, ray])
    for chosen, keys in ((is_back, _back_keys), (is_bright, bright_keys)):
        place, ray = np.nonzero(chosen)
        ends = origins[place] + np.abs(distance[place, ray])[:, None] * directions[place, ray]
        columns[place, ray] = columns_of(hidden, keys(ends))[:, None]
        shares[place, ray, 0] = 1.0
    known = arrivals[..., :3] * (distance > 0)[..., None]
    return Met(columns, shares, known, is_bright, np.abs(distance))


def _is_back(arrivals: NDArray[np.floating]) -> NDArray[np.bool_]:
    """[...] whether surface was met from its back, or has no colour."""
    result = np.asarray(arrivals[..., 3] < 0)
    result[result] = ~_of_another_light(arrivals[result])
    return result


def _of_another_light(behind: NDArray[np.floating]) -> NDArray[np.bool_]:
    """[n] of arrivals [n, 4] at negative distances: whether the surface has a colour, from another light."""
    return np.asarray(behind[:, :3].max(axis=1) > 0)


def _is_bright(arrivals: NDArray[np.floating]) -> NDArray[np.bool_]:
    red, green, blue = np.moveaxis(arrivals[..., :3], -1, 0)  # three times as fast as a maximum along the last axis
    most, least = np.maximum(np.maximum(red, green), blue), np.minimum(np.minimum(red, green), blue)
    return np.asarray((arrivals[..., 3] > 0) & (most >= SATURATED) & (least >= ALL_CHANNELS * most))


def _cell_numbers(cells: Floats | Ints) -> Ints:
    parts = cells.astype(np.int64) + _MIDDLE
    return np.asarray((parts[:, 0] * 2 * _MIDDLE + parts[:, 1]) * 2 * _MIDDLE + parts[:, 2])


def columns_of(hidden: Mapping[int, int], keys: Ints) -> Ints:
    """[n] columns by the `keys` [n] of cells; where there is no such cell the one that others share, or NO_CELL."""
    found, inverse = np.unique(keys, return_inverse=True)
    shared = [*(hidden.get(key, NO_CELL) for key in SHARED), NO_CELL]
    columns = np.array([hidden.get(int(key), shared[key % 3]) for key in found], np.int64)
    return np.asarray(columns[inverse.ravel()])


def _beyond(rows: Ints, rays: Ints, shares: Floats, columns: Ints, count: int) -> NDArray[np.float32]:
    """[count, SIDES, LOBES] of rays [m] that end at the shell's cells `columns` [m]; rows [m]: whose they are."""
    side = rows * SIDES + columns // (SIDE * SIDE)
    sums = csr_matrix((shares.astype(np.float32), (side, rays)), shape=(count * SIDES, RAYS))
    return np.asarray(sums @ _lobes()).reshape(count, SIDES, LOBES)


@cache
def _lobes() -> NDArray[np.float32]:
    """[RAYS, LOBES] along rays."""
    return lobes_along(ray_directions())
