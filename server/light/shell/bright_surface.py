"""Saturated surface as emitters with a place and a size: lamps and windows that a picture shows clipped.

Rays that are spread evenly miss a bulb, or meet it once: its share of what a patch receives would be noise. Each cell
of a grid that holds clipped surface is therefore one emitter, towards which every patch has a ray of its own. What
pictures show of it is averaged over frames, so that it moves with the evidence.
"""

from __future__ import annotations

from collections.abc import Sequence, Set
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.distance import cdist

from server.light.arrivals import RayGroup
from server.light.shell.emitters import Emitters, EmittersSeen, keys_of
from server.light.shell.patches import MOST_PATCHES, MOST_WEIGHT, Patches
from server.light.shell.picture import SeenBright
from server.maths.distinct_rows import distinct_rows
from server.volume.volume import Volume

MOST_EMITTERS = 64
"""Only the largest emitters of a room are kept; evenly spread rays meet the others by chance."""
PRESENCE = 10.0
"""Number of frames over which clipping of a cell is averaged. A lamp that is switched off is gone in half a second."""
LEAST_PRESENCE, MOST_PRESENCE = 0.25, 0.75
"""Share of the frames that show a cell clipped: up to the first value it is no emitter, from the second on it is
one."""
ROUND, FLAT = 2 / 3, 0.9
"""Length of the mean normal of half a sphere, as a picture shows it, and of a plane with a scan's noise."""
MOVED_M = 0.05
"""An emitter that moved by more than this, the size of a bulb, has its visibility traced again."""
_LEAST_COSINE = 0.2

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]


@dataclass(frozen=True)
class TracedEmitters:
    """Rays from patches towards emitters, which are to be traced."""

    emitters: Emitters
    rows: Ints
    """[k] of the emitters."""
    patches: Ints
    """[n] rows."""
    origins: Floats
    """[n, 3] of the rays, world metres."""
    rays: RayGroup


class BrightSurface:
    """Of a room, in rows of its arrays. Frames add to it."""

    def __init__(self) -> None:
        n = MOST_EMITTERS
        self._rows: dict[tuple[int, ...], int] = {}
        self._areas, self._squares = np.zeros(n), np.zeros(n)
        """Sums over frames of the area, and of its square: the mean of areas weighted by themselves is little disturbed
        by frames that show a part."""
        self._centers, self._normals, self._radiance = (np.zeros((n, 3)) for _ in range(3))
        """Sums over frames weighted by the square of the area."""
        self._sums = self._areas, self._squares, self._centers, self._normals, self._radiance
        self._presence, self._frames = np.zeros(n), np.zeros(n)
        self.visibility: NDArray[np.int8] = np.full((MOST_PATCHES, n), -1, np.int8)
        """Of each emitter from each patch: 1, visible; 0, not; -1, not traced."""
        self._traced_at = np.full((n, 3), np.inf)

    def forget(self, share: float) -> None:
        """Take `share` of their weight from all: the light has changed."""
        for values in (*self._sums, self._presence, self._frames):
            np.multiply(values, 1.0 - share, out=values)

    def add(self, bright: SeenBright, positions: Floats) -> None:
        """Fold a picture in; positions: [m, 3] of all surface that it shows, clipped or not."""
        found, cells = distinct_rows(keys_of(bright.positions))
        keys = [tuple(key) for key in found.tolist()]
        self._note_presence(positions, set(keys))
        if not keys:
            return
        shown = _by_cell(bright, cells, len(keys))
        squares = shown.areas_m2**2
        fields = shown.positions, shown.normals, shown.radiance
        added = shown.areas_m2, squares, *(squares[:, None] * values for values in fields)
        for number, key in enumerate(keys):  # one by one: a new one may take the place of another
            row = self._row_of(key, float(shown.areas_m2[number]))
            if row >= 0:
                for sums, values in zip(self._sums, added, strict=True):
                    sums[row] = (1.0 - 1.0 / MOST_WEIGHT) * sums[row] + values[number]

    def _note_presence(self, positions: Floats, shown: Set[tuple[int, ...]]) -> None:
        """Of cells that show as clipped, or where surface is in view that does not."""
        if not self._rows:
            return
        rows = np.array([*self._rows.values()])
        is_shown = np.array([key in shown for key in self._rows])
        centers = self._centers[rows] / np.maximum(self._squares[rows], 1e-12)[:, None]
        apart = cdist(centers, positions, "sqeuclidean").min(axis=1, initial=np.inf)
        areas = self._squares[rows] / np.maximum(self._areas[rows], 1e-12)
        is_in_view = is_shown | (apart <= areas / np.pi)
        rows, is_shown = rows[is_in_view], is_shown[is_in_view]
        self._frames[rows] = np.minimum(self._frames[rows] + 1, PRESENCE)
        self._presence[rows] += (is_shown - self._presence[rows]) / self._frames[rows]

    def _row_of(self, key: tuple[int, ...], area: float) -> int:
        """Its row; a new one takes that of the smallest, if that is smaller. -1: none."""
        if key in self._rows:
            return self._rows[key]
        if len(self._rows) < MOST_EMITTERS:
            row = len(self._rows)
        else:
            smallest = min(self._rows, key=lambda other: self._area(self._rows[other]))
            row = self._rows[smallest]
            if self._area(row) >= area:
                return -1
            del self._rows[smallest]
        for sums in self._sums:
            sums[row] = 0.0
        self._presence[row] = self._frames[row] = 1.0
        self.visibility[:, row], self._traced_at[row] = -1, np.inf
        self._rows[key] = row
        return row

    def _area(self, row: int) -> float:
        return float(self._squares[row] / max(self._areas[row], 1e-12))

    def emitters(self) -> tuple[Emitters, Ints]:
        """Those that count, and their rows [k]."""
        presence = np.clip((self._presence - LEAST_PRESENCE) / (MOST_PRESENCE - LEAST_PRESENCE), 0.0, 1.0)
        keys = [key for key, row in self._rows.items() if presence[row] > 0 and self._squares[row] > 0]
        rows = np.array([self._rows[key] for key in keys], np.int64)
        weights = self._squares[rows][:, None]
        normals = self._normals[rows] / weights
        lengths = np.linalg.norm(normals, axis=1)
        found = Emitters(
            keys=np.array(keys, np.int64).reshape(-1, 3),
            centers=self._centers[rows] / weights,
            facing=normals / np.maximum(lengths, 1e-6)[:, None],
            flatness=_flatness(lengths),
            areas_m2=self._squares[rows] / self._areas[rows],
            radiance=self._radiance[rows] / weights,
            presence=presence[rows],
            is_unseen=np.zeros(len(rows), bool),
        )
        return found, rows

    def seen_by(self) -> EmittersSeen:
        """The emitters, as patches see them; frames do not change it."""
        emitters, rows = self.emitters()
        return EmittersSeen(emitters, (self.visibility[:, rows] > 0).astype(np.float64))

    def begin_trace(self, volume: Volume, patches: Patches, traced: Ints) -> list[TracedEmitters]:
        """Choose which patches are to see which emitters: those in `traced` anew, of the others what is not known."""
        emitters, rows = self.emitters()
        moved = np.linalg.norm(emitters.centers - self._traced_at[rows], axis=1) > MOVED_M
        self._traced_at[rows[moved]] = emitters.centers[moved]
        self.visibility[:, rows[moved]] = -1
        self.visibility[traced] = -1
        used = patches.used
        is_unknown = np.asarray(self.visibility[np.ix_(used, rows)] < 0)
        is_new = np.asarray(is_unknown.all(axis=1))[:, None]
        begun = []
        for is_asked in (is_unknown & is_new, is_unknown & ~is_new):  # all emitters from few patches, few from the rest
            chosen, asked = np.flatnonzero(is_asked.any(axis=0)), used[is_asked.any(axis=1)]
            if len(asked):
                begun.append(_begin(volume, patches, asked, emitters.only(chosen), rows[chosen]))
        return begun

    def end_trace(
        self, volume: Volume, begun: Sequence[TracedEmitters], arrivals: Sequence[NDArray[np.float32]]
    ) -> None:
        """Take over which emitters are visible; arrivals: what the rays of each met."""
        for traced, met in zip(begun, arrivals, strict=True):
            visible = traced.emitters.visible(volume, traced.origins, met)
            self.visibility[np.ix_(traced.patches, traced.rows)] = visible


def _begin(volume: Volume, patches: Patches, asked: Ints, emitters: Emitters, rows: Ints) -> TracedEmitters:
    """From the patches `asked` [n] towards `emitters`, of `rows`."""
    origins = patches.positions[asked] + volume.voxel_m * patches.normals[asked]
    rays = RayGroup(origins - volume.origin_world, None, emitters.directions_from(origins))
    return TracedEmitters(emitters, rows, asked, origins, rays)


def _by_cell(bright: SeenBright, cells: Ints, count: int) -> SeenBright:
    """Means over the blocks in each of `count` cells, and their areas as seen from the front; cells: [n] of blocks."""
    across = np.bincount(cells, bright.areas_m2, count)
    center, normal, radiance = (
        np.stack([np.bincount(cells, bright.areas_m2 * column, count) for column in values.T], axis=1) / across[:, None]
        for values in (bright.positions, bright.normals, bright.radiance)
    )
    line = center - bright.eye
    line /= np.maximum(np.linalg.norm(line, axis=1), 1e-6)[:, None]
    lengths = np.linalg.norm(normal, axis=1)
    flatness = _flatness(lengths)
    cosines = np.maximum(-(normal * line).sum(axis=1) / np.maximum(lengths, 1e-6), _LEAST_COSINE)
    return SeenBright(center, normal, radiance, across / (1 - flatness + flatness * cosines), bright.eye)


def _flatness(lengths: Floats | float) -> Floats:
    """By the length of the mean normal."""
    return np.clip((np.asarray(lengths) - ROUND) / (FLAT - ROUND), 0.0, 1.0)
