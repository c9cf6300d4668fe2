"""How radiance travels in a room: from which unknown cells a patch receives light, and what it is known to receive.

Unknown cells are those of the shell, saturated surface (at least as bright as the picture could show), and surface that
was met from its back or without a colour. Scanned surface sends what the camera saw it send.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from server.light.shell.patches import MOST_PATCHES, RAYS, Patches
from server.light.shell.shell import CELLS, CORNERS, SIDE, SIDES, Shell
from server.maths.lobes import LOBES, lobes_along

HIDDEN_M = 0.6
"""Side of the cells of saturated and of hidden surface: a lamp, a window pane, a piece of furniture."""
MOST_HIDDEN = 128
"""Cells of either kind together; what does not fit shares the last one."""
SATURATED = 0.97
"""Radiance of a channel from which a picture's values are lower bounds: code 252 of 255."""
COLUMNS = CELLS + MOST_HIDDEN
KNOWN, NO_CELL = -1, -2
"""In place of a cell: photographed surface; hidden or saturated surface that no patch has received light from."""
_MIDDLE = 1 << 19  # half the cells along an axis: 150 km
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
    known: Floats
    """[..., 3] radiance of known surface, 0 elsewhere."""
    at_least: Floats
    """[..., 3] what saturated surface sends at least, 0 elsewhere."""


class Transport:
    """Shares of the unknown cells, for all patches."""

    def __init__(self) -> None:
        self.shares: NDArray[np.float32] = np.zeros((MOST_PATCHES, COLUMNS), np.float32)
        """[patches, COLUMNS] share of a patch's cosine-weighted rays that end in each cell."""
        self.beyond: NDArray[np.float32] = np.zeros((MOST_PATCHES, SIDES, LOBES), np.float32)
        """[patches, SIDES, LOBES] what white surface would show of distant lobes, by the side of the shell they come
        in at."""
        self.known: Floats = np.zeros((MOST_PATCHES, 3))
        """[patches, 3] radiance that known surface brings."""
        self.is_saturated = np.zeros(COLUMNS, bool)
        self.at_least: Floats = np.zeros((COLUMNS, 3))
        """[COLUMNS, 3] mean clipped radiance of saturated cells."""
        self._counts = np.zeros(COLUMNS)
        self.hidden: dict[int, int] = {}
        """Columns of the cells of hidden and of saturated surface, by their keys."""
        self._shell: Shell | None = None

    @property
    def columns(self) -> int:
        """Cells that exist."""
        return CELLS + len(self.hidden)

    def update(self, patches: Patches, traced: Ints, shell: Shell) -> None:
        """Fold in the patches whose rays were traced; all patches, where the shell has changed."""
        rows = traced if shell is self._shell else patches.used
        self._shell = shell
        if len(rows) == 0:
            return
        origins, directions = patches.positions[rows], patches.directions[rows].astype(np.float64)
        arrivals = patches.arrivals[rows].astype(np.float64)
        for is_bright, keys in enumerate(_hidden_keys(origins, directions, arrivals)):
            self._add_cells(keys, is_saturated=bool(is_bright))
        met = meet(shell, self.hidden, origins, directions, arrivals)
        self._note_bright(met)
        place = COLUMNS * np.arange(len(rows))[:, None, None] + np.maximum(met.columns, 0)
        sums = np.bincount(place.ravel(), met.shares.ravel() / RAYS, len(rows) * COLUMNS)
        self.shares[rows] = sums.reshape(len(rows), COLUMNS)
        is_free = patches.arrivals[rows, :, 3] == 0
        self.beyond[rows] = _beyond(directions, np.where(is_free, met.columns[..., 0], KNOWN))
        self.known[rows] = met.known.mean(axis=1)

    def _add_cells(self, keys: Ints, *, is_saturated: bool) -> None:
        for key in np.unique(keys):
            if int(key) not in self.hidden and len(self.hidden) < MOST_HIDDEN:
                self.is_saturated[self.columns] = is_saturated
                self.hidden[int(key)] = self.columns

    def _note_bright(self, met: Met) -> None:
        is_bright = met.at_least.max(axis=-1) > 0
        columns, radiance = met.columns[is_bright, 0], met.at_least[is_bright]
        counts = np.bincount(columns, minlength=COLUMNS).astype(np.float64)
        sums = np.stack([np.bincount(columns, channel, COLUMNS) for channel in radiance.T], axis=1)
        total = self._counts + counts
        share = np.where(total > 0, counts / np.maximum(total, 1.0), 0.0)[:, None]
        self.at_least += share * (sums / np.maximum(counts, 1.0)[:, None] - self.at_least)
        self._counts = np.minimum(total, _MOST_COUNTED)


def meet(shell: Shell, hidden: Mapping[int, int], origins: Floats, directions: Floats, arrivals: Floats) -> Met:
    """What rays from `origins` [n, 3] (world) along `directions` [n, m, 3] meet; arrivals [n, m, 4] as traced.

    hidden: as of Transport.
    """
    distance, radiance = arrivals[..., 3], arrivals[..., :3]
    is_bright, is_free = _is_bright(arrivals), distance == 0
    columns = np.full((*distance.shape, CORNERS), KNOWN, np.int64)
    shares = np.zeros((*distance.shape, CORNERS))
    starts = np.broadcast_to(origins[:, None], directions.shape)
    columns[is_free], shares[is_free] = shell.exits(starts[is_free], directions[is_free])
    back, bright = _hidden_keys(origins, directions, arrivals)
    for chosen, keys in ((distance < 0, back), (is_bright, bright)):
        columns[chosen] = _columns_of(hidden, keys)[:, None]
        shares[chosen, 0] = 1.0
    known = np.where(((distance > 0) & ~is_bright)[..., None], radiance, 0.0)
    return Met(columns, shares, known, np.where(is_bright[..., None], radiance, 0.0))


def _is_bright(arrivals: Floats) -> NDArray[np.bool_]:
    return np.asarray((arrivals[..., 3] > 0) & (arrivals[..., :3].max(axis=-1) >= SATURATED))


def _hidden_keys(origins: Floats, directions: Floats, arrivals: Floats) -> tuple[Ints, Ints]:
    """Keys of the cells of hidden surface and of saturated surface, one of each ray that meets such."""
    row, ray = np.nonzero(arrivals[..., 3] < 0)
    bright_row, bright_ray = np.nonzero(_is_bright(arrivals))
    distance = np.abs(arrivals[..., 3, None])
    back = origins[row] + distance[row, ray] * directions[row, ray]
    bright = origins[bright_row] + distance[bright_row, bright_ray] * directions[bright_row, bright_ray]
    return 2 * _cell_numbers(back), 2 * _cell_numbers(bright) + 1


def _cell_numbers(points: Floats) -> Ints:
    parts = np.floor(points / HIDDEN_M).astype(np.int64) + _MIDDLE
    return np.asarray((parts[:, 0] * 2 * _MIDDLE + parts[:, 1]) * 2 * _MIDDLE + parts[:, 2])


def _columns_of(hidden: Mapping[int, int], keys: Ints) -> Ints:
    """[n] columns by the `keys` [n] of cells; where there is no such cell NO_CELL, or the last one if no more fit."""
    found, inverse = np.unique(keys, return_inverse=True)
    other = COLUMNS - 1 if len(hidden) >= MOST_HIDDEN else NO_CELL
    columns = np.array([hidden.get(int(key), other) for key in found], np.int64)
    return np.asarray(columns[inverse.ravel()])


def _beyond(directions: Floats, columns: Ints) -> NDArray[np.float32]:
    """[n, SIDES, LOBES] of rays `directions` [n, m, 3] that end at the shell's cells `columns` [n, m], or KNOWN."""
    row, ray = np.nonzero(columns >= 0)
    group = row * SIDES + columns[row, ray] // (SIDE * SIDE)
    order = np.argsort(group, kind="stable")
    result = np.zeros((len(columns) * SIDES, LOBES), np.float32)
    if len(order):
        groups, starts = np.unique(group[order], return_index=True)
        result[groups] = np.add.reduceat(lobes_along(directions[row, ray][order]), starts, axis=0) / columns.shape[1]
    return result.reshape(len(columns), SIDES, LOBES)
