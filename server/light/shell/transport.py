"""How radiance travels in a room: from which unknown cells a patch receives light, and what it is known to receive.

Unknown cells are those of the shell, saturated surface (at least as bright as the picture could show), and surface that
was met from its back or without a colour. Scanned surface sends what the camera saw it send.
"""

from __future__ import annotations

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
        self._hidden: dict[int, int] = {}
        self._shell: Shell | None = None

    @property
    def columns(self) -> int:
        """Cells that exist."""
        return CELLS + len(self._hidden)

    def update(self, patches: Patches, traced: Ints, shell: Shell) -> None:
        """Fold in the patches whose rays were traced; all patches, where the shell has changed."""
        rows = traced if shell is self._shell else patches.used
        self._shell = shell
        if len(rows) == 0:
            return
        directions = patches.directions[rows].astype(np.float64)
        met = self.meet(
            shell, patches.positions[rows], directions, patches.arrivals[rows].astype(np.float64), learn=True
        )
        place = COLUMNS * np.arange(len(rows))[:, None, None] + np.maximum(met.columns, 0)
        sums = np.bincount(place.ravel(), met.shares.ravel() / RAYS, len(rows) * COLUMNS)
        self.shares[rows] = sums.reshape(len(rows), COLUMNS)
        is_free = patches.arrivals[rows, :, 3] == 0
        self.beyond[rows] = _beyond(directions, np.where(is_free, met.columns[..., 0], KNOWN))
        self.known[rows] = met.known.mean(axis=1)

    def meet(self, shell: Shell, origins: Floats, directions: Floats, arrivals: Floats, *, learn: bool = False) -> Met:
        """What rays from `origins` [n, 3] (world) along `directions` [n, m, 3] meet; arrivals [n, m, 4] as traced.

        learn: cells that did not exist are added, and saturated ones note their radiance.
        """
        distance, radiance = arrivals[..., 3], arrivals[..., :3]
        is_bright = (distance > 0) & (radiance.max(axis=-1) >= SATURATED)
        is_back = distance < 0
        is_free = distance == 0
        columns = np.full((*distance.shape, CORNERS), KNOWN, np.int64)
        shares = np.zeros((*distance.shape, CORNERS))
        starts = np.broadcast_to(origins[:, None], directions.shape)
        columns[is_free], shares[is_free] = shell.exits(starts[is_free], directions[is_free])
        ends = starts + np.abs(distance)[..., None] * directions
        for kind, chosen in ((0, is_back), (1, is_bright)):
            columns[chosen] = self._hidden_columns(ends[chosen], kind, learn=learn)[:, None]
            shares[chosen, 0] = 1.0
        if learn and is_bright.any():
            self._note_bright(columns[is_bright, 0], radiance[is_bright])
        known = np.where(((distance > 0) & ~is_bright)[..., None], radiance, 0.0)
        return Met(columns, shares, known, np.where(is_bright[..., None], radiance, 0.0))

    def _hidden_columns(self, points: Floats, kind: int, *, learn: bool) -> Ints:
        """[n] columns of the cells around `points` [n, 3], NO_CELL where there is none yet."""
        if len(points) == 0:
            return np.zeros(0, np.int64)
        parts = np.floor(points / HIDDEN_M).astype(np.int64) + _MIDDLE
        numbers = (parts[:, 0] * 2 * _MIDDLE + parts[:, 1]) * 2 * _MIDDLE + parts[:, 2]
        keys, inverse = np.unique(2 * numbers + kind, return_inverse=True)
        columns = np.array([self._hidden_column(int(key), learn=learn) for key in keys])
        return np.asarray(columns[inverse.ravel()], np.int64)

    def _hidden_column(self, key: int, *, learn: bool) -> int:
        if key not in self._hidden and learn:
            if len(self._hidden) >= MOST_HIDDEN:
                return COLUMNS - 1
            self._hidden[key] = self.columns
            self.is_saturated[self._hidden[key]] = key % 2 == 1
        return self._hidden.get(key, NO_CELL)

    def _note_bright(self, columns: Ints, radiance: Floats) -> None:
        counts = np.bincount(columns, minlength=COLUMNS).astype(np.float64)
        sums = np.stack([np.bincount(columns, channel, COLUMNS) for channel in radiance.T], axis=1)
        total = self._counts + counts
        share = np.where(total > 0, counts / np.maximum(total, 1.0), 0.0)[:, None]
        self.at_least += share * (sums / np.maximum(counts, 1.0)[:, None] - self.at_least)
        self._counts = np.minimum(total, _MOST_COUNTED)


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
