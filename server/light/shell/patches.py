"""Evidence about a room's light: what small patches of its surface show, and what reaches each of them.

A patch is what one cell of a grid in the world holds of surface that faces one way; all surface lies in a patch of each
of GRIDS grids. Frames add to it, so memory follows the surface that was seen, not the number of frames. Kernel:
arrivals.cl.
"""

from __future__ import annotations

from copy import copy
from dataclasses import dataclass
from functools import cache

import numpy as np
from numpy.typing import NDArray

from server.light.arrivals import RayGroup
from server.light.shell.known_room import KnownPatches
from server.light.shell.picture import Seen
from server.maths.distinct_rows import distinct_rows
from server.maths.sh import in_bundles, spherical_fibonacci

PATCH_M = 0.15
"""Side of a grid's cells in a room. Shading changes little within one, except at contacts; a room has about 1000
patches in each grid."""
GRIDS = 2
"""Grids, each shifted by 1 / GRIDS of a cell against the one before, along each axis. Where the cells of one lie only
the origin of the world decides, and with another the light of the real kitchen turned by up to 10 degrees, for the mean
of two grids by 2.5; three are hardly steadier (docs/light_experiments.md). A solution takes as long as it has patches.
"""
ROOM_M = 2.0
"""Diagonal of the smallest scan that is a room, or a corner of one. What is smaller is a table with things on it, of
which a patch must not hold a whole one: with PATCH_M the light of the stage set, 1.5 m across, errs by 16 degrees, with
half of it by 8, with a quarter by 8 too, but stripes painted on a table then turn it by 50 instead of 28. The corner of
a room 3 m across (mitsuba_room) errs by 21 degrees with half of it instead of 14: one surface falls into many."""
_OUTLIERS = 0.01
"""Share of the surface that may lie farther out on either side: stray depth."""
LEAST_VOXELS = 4.0
"""Least side of a cell, in voxels: finer than that the scan has no normals."""
REGION_M = 0.4
"""Side of the regions over which a material may differ from what its colour says (objective.py), beside patches of
PATCH_M; beside smaller ones as much smaller."""
MOST_PATCHES = 1536 * GRIDS
"""Beyond this number a new patch replaces the one that was not seen for longest. One picture shows an eighth of it."""
RAYS = 1024
"""Directions, evenly spread and the same for all patches, of which half are above the plane of each. With a quarter of
them, what a window sends to a patch is a tenth off, and the light turns by as much as with another room."""
TRACED_A_FRAME = 16
"""Patches whose rays are traced again in each frame, once all have been traced: the scan around them keeps growing."""
OUTDATED_LEFT = 0.5
"""Share of what is outdated that still is a frame later: more of the scan is seen under the new light by then."""
MOST_WEIGHT = 30.0
"""Number of frames over which a patch is averaged."""
_FORGOTTEN = 1e-3  # frames: a patch of less weight is none
_CHANGED_BY_FRAMES = (
    *("weights", "positions", "normals", "logarithms", "variances", "clipped"),
    *("keys", "regions", "seen_in", "traced_in", "_numbers"),
)
_FREE = -1  # number of a row without a patch
_FACINGS = 1.2  # normals are rounded to multiples of 1 / 1.2: 26 ways to face
_KEY = 7  # numbers in a key
_CELL_BITS = 18  # 131 072 cells to either side: 19 km in a room

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]


def patch_side_m(positions: Floats, voxel_m: float) -> float:
    """Side of the patches of a scan of surface at `positions` [n, 3]: PATCH_M, and half of that each time it is less
    than ROOM_M across, half of that, and so on."""
    low, high = np.quantile(positions, (_OUTLIERS, 1 - _OUTLIERS), axis=0)
    across_m = max(float(np.linalg.norm(high - low)), voxel_m)
    side_m = PATCH_M * 2.0 ** np.floor(np.log2(across_m / ROOM_M))
    return float(min(max(side_m, LEAST_VOXELS * voxel_m), PATCH_M))


@dataclass(frozen=True)
class TracedPatches:
    """Patches whose rays are to be traced."""

    rows: Ints
    rays: RayGroup


class Patches:
    """The patches of a room, in rows 0 to `count` of its arrays."""

    def __init__(self, side_m: float = PATCH_M) -> None:
        """`side_m`: of the grids' cells."""
        n = MOST_PATCHES
        self.side_m = side_m
        self._numbers = np.full(n, _FREE)
        """key_numbers of the patch in each row."""
        self.weights = np.zeros(n)
        """Frames in the mean; 0: a row without a patch."""
        self.positions, self.normals, self.logarithms = np.zeros((n, 3)), np.zeros((n, 3)), np.zeros((n, 3))
        self.variances, self.clipped = np.zeros(n), np.zeros(n)
        self.keys = np.zeros((n, _KEY), np.int64)
        """Cell of the grid, rounded normal, and number of the grid."""
        self.regions = np.zeros(n, np.int64)
        """Which region of its grid each lies in: equal numbers, the same one."""
        self.seen_in, self.traced_in = np.full(n, -1), np.full(n, -1)
        """Number of the last frame that showed it, or in which its rays were traced; -1: none."""
        self.arrivals = np.zeros((n, RAYS, 4), np.float32)
        """What the rays along `ray_directions` met, as of trace_arrivals; of no meaning below the plane."""
        self.traced_normals = np.zeros((n, 3))
        """Above whose planes rays were traced."""
        self.outdated = 0.0
        """Share of the patches whose rays met surface under another light; what is solved is far from the new one."""
        self._frame = 0
        self._grouped: tuple[Seen, Ints, _Means] | None = None
        """The last picture's, which is asked for twice."""

    @property
    def used(self) -> Ints:
        """Rows of patches whose rays were traced."""
        return np.flatnonzero((self.weights > 0) & (self.traced_in >= 0))

    def changes(self, seen: Seen) -> tuple[Floats, Ints]:
        """[k] log of the mean radiance of the patches of a picture over what they showed before, and which face alike.

        Equal numbers [k], from 0: patches of one grid that face one way.
        """
        keys, mean = self._groups(seen)
        rows = self._known_rows(keys)
        is_known = (rows >= 0) & (self.weights[rows] > 0)
        now = mean.of(seen.logarithms)[is_known].mean(axis=1)
        facing = distinct_rows(keys[is_known, 3:])[1]
        return np.asarray(now - self.logarithms[rows[is_known]].mean(axis=1)), facing

    def forget(self, share: float) -> None:
        """Take `share` of their weight from all patches: the light has changed."""
        self.weights *= 1.0 - share
        self.weights[self.weights < _FORGOTTEN] = 0.0
        self.outdated = max(OUTDATED_LEFT * self.outdated, share)

    def add(self, seen: Seen) -> None:
        """Fold a picture in; of one with more than MOST_PATCHES patches, those that find a row."""
        self._frame += 1
        keys, mean = self._groups(seen)
        rows = self._rows_of(keys)
        has_row = rows >= 0
        rows = rows[has_row]

        def shown(values: Floats) -> Floats:
            return mean.of(values)[has_row]

        weights = self.weights[rows]
        share = 1.0 / (np.minimum(weights, MOST_WEIGHT - 1) + 1.0)
        columns = share[:, None]
        self.logarithms[rows] += columns * (shown(seen.logarithms) - self.logarithms[rows])
        self.positions[rows] += columns * (shown(seen.positions) - self.positions[rows])
        normals = self.normals[rows] + columns * (shown(seen.normals) - self.normals[rows])
        self.normals[rows] = normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-9)
        self.variances[rows] += share * (shown(seen.variances[:, None])[:, 0] - self.variances[rows])
        self.clipped[rows] += share * (shown(seen.clipped[:, None])[:, 0] - self.clipped[rows])
        self.weights[rows] = np.minimum(weights + 1.0, MOST_WEIGHT)
        self.seen_in[rows] = self._frame

    @property
    def has_walls(self) -> bool:
        """Whether upright surface may be a wall; in a scan that is smaller than a room's it is of things on a table."""
        return self.side_m >= PATCH_M

    @property
    def area_m2(self) -> float:
        """Surface that each patch stands for."""
        return self.side_m**2 / GRIDS

    @property
    def is_empty(self) -> bool:
        """Whether it has no patch yet."""
        return bool(np.all(self._numbers == _FREE))

    @property
    def fresh(self) -> int:
        """Number of patches whose rays were not traced yet."""
        return int(((self.weights > 0) & (self.traced_in < 0)).sum())

    def begin_trace(self, origin_world: Floats, frames: int = 1) -> TracedPatches:
        """Choose those that have no rays yet, and of the others those traced longest ago, TRACED_A_FRAME for each of
        `frames`, or more where the light is another. Until `end_trace`, their arrivals are the last ones.

        origin_world: [3] of the volume in which they are traced.
        """
        alive = np.flatnonzero(self.weights > 0)
        order = alive[np.argsort(self.traced_in[alive], kind="stable")]
        fresh = int((self.traced_in[order] < 0).sum())
        rows = order[: max(fresh, frames * TRACED_A_FRAME, round(self.outdated * len(order)))]
        self.traced_normals[rows] = normals = self.normals[rows]
        self.traced_in[rows] = self._frame
        return TracedPatches(rows, RayGroup(self.positions[rows] - origin_world, normals, ray_directions()[None]))

    def end_trace(self, traced: TracedPatches, arrivals: NDArray[np.float32]) -> None:
        """Take over what the rays met."""
        self.arrivals[traced.rows] = arrivals

    def copy(self) -> Patches:
        """For reading: what frames add does not reach it. Rays, which `end_trace` alone changes, are shared."""
        other = copy(self)
        other._grouped = None
        for name in _CHANGED_BY_FRAMES:
            setattr(other, name, getattr(self, name).copy())
        return other

    def grown(self, side_m: float) -> Patches:
        """The same with cells of `side_m`, all as old as the oldest; their rays are not traced yet."""
        return _in_cells_of(side_m, self.known())

    @property
    def seen(self) -> Ints:
        """Rows of all patches, with or without rays."""
        return np.flatnonzero(self.weights > 0)

    def known(self) -> KnownPatches:
        """All but their rays."""
        rows = np.flatnonzero(self._numbers != _FREE)
        return KnownPatches(
            self.keys[rows],
            self.positions[rows],
            self.normals[rows],
            self.logarithms[rows],
            self.variances[rows],
            self.clipped[rows],
            self.weights[rows],
            self.side_m,
        )

    @staticmethod
    def resumed(known: KnownPatches) -> Patches:
        """Begin with these, at most MOST_PATCHES; their rays are traced with the next."""
        if known.keys.shape[1] < _KEY:  # saved by an earlier program, with one grid
            return _in_cells_of(known.side_m, known)
        patches = Patches(known.side_m)
        rows = patches._rows_of(known.keys)
        for name in ("positions", "normals", "logarithms", "variances", "clipped", "weights"):
            getattr(patches, name)[rows] = getattr(known, name)
        return patches

    def _groups(self, seen: Seen) -> tuple[Ints, _Means]:
        """As of _grouped."""
        if self._grouped is None or self._grouped[0] is not seen:
            self._grouped = seen, *_grouped(seen, self.side_m)
        return self._grouped[1:]

    def _known_rows(self, keys: Ints) -> Ints:
        """Rows of patches by key, -1 for those that are not there."""
        numbers, order = key_numbers(keys), np.argsort(self._numbers)
        rows = order[np.minimum(np.searchsorted(self._numbers, numbers, sorter=order), MOST_PATCHES - 1)]
        return np.where(self._numbers[rows] == numbers, rows, -1)

    def _rows_of(self, keys: Ints) -> Ints:
        """Rows of patches by key, new ones included; -1 for those that find no more room."""
        rows = self._known_rows(keys)
        new = np.flatnonzero(rows < 0)
        self._make_room(len(new), rows[rows >= 0])
        free = np.flatnonzero(self._numbers == _FREE)[: len(new)]
        new = new[: len(free)]
        rows[new] = free
        self._numbers[free] = key_numbers(keys[new])
        self.weights[free], self.traced_in[free] = 0.0, -1
        self.keys[free], self.regions[free] = keys[new], _region_numbers(keys[new])
        return rows

    def _make_room(self, wanted: int, kept: Ints) -> None:
        """Forget patches until `wanted` rows are free, those seen longest ago first and `kept` rows last."""
        used = np.flatnonzero(self._numbers != _FREE)
        excess = len(used) + wanted - MOST_PATCHES
        if excess <= 0:
            return
        seen_in = self.seen_in.copy()
        seen_in[kept] = self._frame
        forgotten = used[np.argsort(seen_in[used], kind="stable")[:excess]]
        self.weights[forgotten], self._numbers[forgotten] = 0.0, _FREE


def key_numbers(keys: Ints) -> Ints:
    """[n] a number for each key [n, 7], distinct within 2^_CELL_BITS cells along each axis."""
    cells = (keys[:, :3] + (1 << _CELL_BITS - 1)) @ (1 << (_CELL_BITS * np.arange(3, dtype=np.int64)))
    return np.asarray((cells * GRIDS + keys[:, 6] << 6) + (keys[:, 3:6] + 1) @ np.array([1, 4, 16]))


def _region_numbers(keys: Ints) -> Ints:
    """[n] a number for each region of patches, by their keys [n, 7]."""
    cells = np.floor(keys[:, :3] * (PATCH_M / REGION_M)).astype(np.int64)
    return key_numbers(np.concatenate([cells, keys[:, 3:]], axis=1))


def _grouped(seen: Seen, side_m: float) -> tuple[Ints, _Means]:
    """Keys of the patches in a picture, [k, 7] distinct, and means over what it shows of each."""
    shift = np.arange(GRIDS)[:, None, None] / GRIDS
    cells = np.floor(seen.positions / side_m + shift).astype(np.int64)
    facing = np.rint(seen.normals * _FACINGS).astype(np.int64)
    grid = np.repeat(np.arange(GRIDS), seen.count)
    keys, inverse = distinct_rows(np.column_stack([cells.reshape(-1, 3), np.tile(facing, (GRIDS, 1)), grid]))
    return keys, _Means(inverse, np.bincount(inverse, minlength=len(keys)).astype(np.float64))


def _in_cells_of(side_m: float, known: KnownPatches) -> Patches:
    """The known ones put together to patches of cells of `side_m`, all as old as the oldest; not traced yet."""
    patches, rows = Patches(side_m), np.flatnonzero(known.weights > 0)
    turned = known.positions[rows], known.normals[rows], known.logarithms[rows]
    patches.add(Seen(*turned, known.variances[rows], known.clipped[rows]))
    patches.weights[patches.seen] = known.weights.max(initial=0.0)
    return patches


class _Means:
    """Means over groups of equal number, in each of GRIDS."""

    def __init__(self, groups: Ints, counts: Floats) -> None:
        self._groups, self._counts = groups, counts

    def of(self, values: Floats) -> Floats:
        """[groups, k] of values [n, k]."""
        values = np.tile(values, (GRIDS, 1))
        columns = [np.bincount(self._groups, column, len(self._counts)) for column in values.T]
        return np.asarray(np.stack(columns, axis=1) / self._counts[:, None])


@cache
def ray_directions() -> Floats:
    """[RAYS, 3] unit, world axes."""
    return in_bundles(spherical_fibonacci(RAYS))


def hemisphere_weights(normals: Floats) -> Floats:
    """[n, RAYS] how far rays count at surface with unit `normals` [n, 3]: as their cosine, with sum 1."""
    cosines = np.maximum(normals @ ray_directions().T, 0.0)
    return np.asarray(cosines / np.maximum(cosines.sum(axis=1, keepdims=True), 1e-9))
