"""Lamps that stand or hang in the room where no picture has looked.

The shell has no place for them: put on the wall behind, such a lamp is in another direction from every patch than it
is. Whether there is one, and where, the objective tells: a small source at each place of a grid, with all unknowns
going along, would lower it by so much (`profile`). The best place is looked at closely. A lamp is taken where several
solutions find it, and goes on to where the objective is lower.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cache

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from server.light.shell.emitters import Emitters, EmittersSeen
from server.light.shell.objective import Linear, profile
from server.light.shell.patches import MOST_PATCHES, RAYS, Patches, ray_directions
from server.light.shell.shell import Shell
from server.light.shell.transport import MOST_LAMPS
from server.light.shell.unknowns import Unknowns
from server.light.shell.view import View

BULB_M = 0.12
"""Radius of a lamp. What patches receive tells its power, not its size."""
GRID_M = 0.5
"""Spacing of the places at which a lamp is looked for: half a metre off, a lamp still explains half of what it would at
its place."""
FINER = 0.5, 0.25, 0.125
"""Steps by which the best place is found, as shares of GRID_M: to 6 cm."""
FROM_SIDES_M, OVER_FLOOR_M = 0.2, 0.6
"""Least distance from the shell's sides, on which lamps have a place, and height: of a lamp on a low table."""
LIKELY, FOUND = 8.0, 15.0
"""By how much a lamp makes what pictures show more probable (natural logarithm), before its place is looked at closely,
and at its place. In rooms with such a lamp it is 25 to 43 after a second; in others 13 at most, before that for some
frames up to 20 (docs/light_experiments.md)."""
AGAIN = 3
"""Searches in a row that must find it, not farther apart than GRID_M."""
YOUNG, FIRST_SEARCHES, SEARCH_EVERY = 5, 24, 4
"""Lamps are looked for, and moved, after so many solutions, since a lamp at many a place explains a few pictures; then
with each one until there were so many, in a second and a half; and then with every so many."""
STEP_M, MOST_STEP_M = 0.2, 0.1
"""Standard deviation of a step of a lamp, and the greatest one."""
WIDER = 2.0
"""Steps are so many times as wide as Newton's: what patches see changes by jumps, and curvature takes these for
evidence."""
SEEN_DEG, SEEN_M = 4.0, 0.2
"""A picture looks through a place with no patch before it, by more than the second value, within this angle: patches
of .15 m are so far apart at two metres."""
NEAREST_RAYS = 8
"""Rays of a patch that tell how far it sees a place, those that point nearest there: by 13 degrees beside it at most.
Of fewer, what patches see changes by jumps where a lamp moves."""
TABLE = 64
"""Cells along a side of the table that tells which rays these are."""
_DIFFERENCE_M = 0.15  # over less, what patches see changes by jumps

Floats = NDArray[np.float64]
Singles = NDArray[np.float32]
Ints = NDArray[np.int64]


@dataclass(frozen=True)
class Room:
    """A solution in which lamps are looked for."""

    unknowns: Unknowns
    here: Linear
    """The objective about them."""
    patches: Patches
    rows: Ints
    """[n] of the patches that the objective explains."""
    shell: Shell

    def columns(self, places: Floats) -> Singles:
        """[n, m] derivatives of the log radiance of patches by the radiance of a lamp at each of `places` [m, 3]."""
        shares, visible = lamp_shares(self.patches, self.rows, places)
        return np.asarray(shares * visible / self.here.arriving[:, None], np.float32)

    def gains(self, places: Floats) -> Floats:
        """[m] by how much a lamp at each of `places` [m, 3] makes what pictures show more probable."""
        columns = self.columns(places)
        columns /= np.maximum(np.linalg.norm(columns, axis=0), 1e-12)
        slope, curvature = profile(self.unknowns, self.here, columns)
        return np.asarray(np.maximum(slope, 0.0) ** 2 / (2 * np.maximum(np.diag(curvature), 1e-6)))

    def inside(self, places: Floats) -> NDArray[np.bool_]:
        """[m] whether `places` [m, 3] are where a lamp may be."""
        along = places @ self.shell.axes.T
        low, high = self.shell.low + FROM_SIDES_M, self.shell.high - FROM_SIDES_M
        return np.asarray(((along > low) & (along < high)).all(axis=1))


@dataclass
class UnseenLamps:
    """Of a room. World axes and metres."""

    centers: dict[int, Floats] = field(default_factory=dict)
    """[3] of each lamp, by its number, below MOST_LAMPS."""
    _origin: Floats = field(default_factory=lambda: np.full(3, np.nan))
    _seen: set[tuple[int, ...]] = field(default_factory=set)
    """Places of the grid that pictures have looked through."""
    _likely: list[Floats] = field(default_factory=list)
    """Where the last searches found a lamp."""
    _solutions: int = 0

    def note(self, view: View, shell: Shell, patches: Patches) -> None:
        """A picture shows that there is no lamp in the air it looks through."""
        keys, places = self._grid(shell)
        in_frame = np.flatnonzero(view.frames(places))
        towards, far = _directions(places[in_frame], view.eye)
        surface, depth = _directions(patches.positions[patches.used], view.eye)
        is_before = depth < far[:, None] - SEEN_M
        is_hidden = (is_before & (towards @ surface.T > np.cos(np.radians(SEEN_DEG)))).any(axis=1)
        self._seen |= {tuple(key) for key in keys[in_frame[~is_hidden]].tolist()}
        for number in [number for number, center in self.centers.items() if self._are_seen(center[None], shell)[0]]:
            del self.centers[number]

    def forget(self) -> None:
        """The light is another one. What pictures look through stays known."""
        self.centers, self._likely, self._solutions = {}, [], 0

    def beside(self, bright: EmittersSeen, patches: Patches) -> EmittersSeen:
        """The emitters of `bright`, then the lamps."""
        if not self.centers:
            return bright
        centers, count = np.array([*self.centers.values()]), len(self.centers)
        lamps = Emitters(
            keys=np.array([(number, 0, 0) for number in self.centers]),
            centers=centers,
            facing=np.tile([0.0, 0.0, 1.0], (count, 1)),
            flatness=np.zeros(count),
            areas_m2=np.full(count, np.pi * BULB_M**2),
            radiance=np.ones((count, 3)),  # as all that is clipped in the first picture
            presence=np.ones(count),
            is_unseen=np.ones(count, bool),
        )
        visible = np.zeros((MOST_PATCHES, count))
        visible[patches.used] = lamp_shares(patches, patches.used, centers)[1]
        return EmittersSeen(bright.emitters.and_(lamps), np.concatenate([bright.visible, visible], axis=1))

    def follow(self, room: Room, sent: dict[int, float]) -> None:
        """Move the lamps, drop those that send no more than what is clipped, and look for more.

        sent: radiance of each, over that of what is clipped.
        """
        for number in [number for number, radiance in sent.items() if radiance < 1.0]:
            del self.centers[number]
        self._solutions += 1
        is_rare = self._solutions > FIRST_SEARCHES and self._solutions % SEARCH_EVERY
        if self._solutions <= YOUNG or is_rare:
            return
        for number in self.centers:
            self._move(number, sent[number], room)
        if len(self.centers) < MOST_LAMPS:
            self._search(room)

    def _move(self, number: int, radiance: float, room: Room) -> None:
        center = self.centers[number]
        ends = room.columns(np.concatenate([center + side * _DIFFERENCE_M * np.eye(3) for side in (1, -1)]))
        columns = np.float32(radiance / (2 * _DIFFERENCE_M)) * (ends[:, :3] - ends[:, 3:])
        slope, curvature = profile(room.unknowns, room.here, columns)
        step = WIDER * np.linalg.solve(curvature + np.eye(3) / STEP_M**2, slope)
        moved = center + step * min(1.0, MOST_STEP_M / max(float(np.linalg.norm(step)), 1e-12))
        if room.inside(moved[None])[0] and not self._are_seen(moved[None], room.shell)[0]:
            self.centers[number] = moved

    def _search(self, room: Room) -> None:
        keys, places = self._grid(room.shell)
        places = places[[tuple(key) not in self._seen for key in keys.tolist()]]
        found = _best(room, places, lambda near: ~self._are_seen(near, room.shell)) if len(places) else None
        is_same = found is not None and all(np.linalg.norm(found - other) <= GRID_M for other in self._likely)
        self._likely = [*(self._likely if is_same else []), *([] if found is None else [found])]
        if len(self._likely) == AGAIN:
            number = min(set(range(MOST_LAMPS)) - self.centers.keys())
            self.centers[number], self._likely = np.mean(self._likely, axis=0), []

    def _grid(self, shell: Shell) -> tuple[Ints, Floats]:
        """[k, 3] keys of the grid's places in the shell, and where they are."""
        if np.isnan(self._origin).any():
            self._origin = np.append(shell.low[:2], shell.floor_m + OVER_FLOOR_M)
        first = np.ceil((shell.low + FROM_SIDES_M - self._origin) / GRID_M).astype(np.int64)
        last = np.floor((shell.high - FROM_SIDES_M - self._origin) / GRID_M).astype(np.int64)
        first[2] = max(first[2], 0)
        steps = [np.arange(low, high + 1) for low, high in zip(first, last, strict=True)]
        keys = np.stack(np.meshgrid(*steps, indexing="ij"), axis=-1).reshape(-1, 3)
        return keys, (self._origin + GRID_M * keys) @ shell.axes

    def _are_seen(self, places: Floats, shell: Shell) -> NDArray[np.bool_]:
        """[m] whether pictures look through the grid's place nearest to each of `places` [m, 3]."""
        keys = np.rint((places @ shell.axes.T - self._origin) / GRID_M).astype(np.int64)
        return np.array([tuple(key) in self._seen for key in keys.tolist()], bool)


def _best(room: Room, places: Floats, may_be: Callable[[Floats], NDArray[np.bool_]]) -> Floats | None:
    """[3] the place of a lamp, from the best of `places` [m, 3]; None: there is none. may_be: [m] whether one may be at
    places [m, 3]."""
    gains = room.gains(places)
    best = places[gains.argmax()]
    if gains.max() < LIKELY:
        return None
    for share in FINER:
        around = best + share * GRID_M * np.stack(np.meshgrid(*[[-1, 0, 1]] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
        around = around[room.inside(around) & may_be(around)]
        if not len(around):  # a place on the very edge, with seen air inside of it
            return None
        gains = room.gains(around)
        best = around[gains.argmax()]
    return best if gains.max() >= FOUND else None


def _directions(points: Floats, eye: Floats) -> tuple[Floats, Floats]:
    """[n, 3] unit towards `points` [n, 3] from `eye` [3], and [n] how far they are."""
    towards = points - eye
    far = np.maximum(np.linalg.norm(towards, axis=1), 1e-6)
    return towards / far[:, None], far


def lamp_shares(patches: Patches, rows: Ints, places: Floats) -> tuple[Singles, Singles]:
    """[n, m] shares of the cosine-weighted hemispheres of the patches in `rows` [n] that lamps at `places` [m, 3] fill,
    and how far patches see them, from 0 to 1, by the rays of each that point nearest there; 0 where the share is 0."""
    # An axis at a time, in single precision: there are hundreds of thousands.
    positions, normals = (part[rows].T[:, :, None].astype(np.float32) for part in (patches.positions, patches.normals))
    x, y, z = places.T[:, None].astype(np.float32) - positions
    squared = x * x + y * y + z * z
    far = np.sqrt(np.maximum(squared, 1e-12))
    cosines = np.maximum((x * normals[0] + y * normals[1] + z * normals[2]) / far, 0.0)
    area = np.float32(np.pi * BULB_M**2)
    above = np.flatnonzero(cosines)
    first_ray, far = RAYS * rows[above // len(places)], far.take(above)
    cells = _cells(*(along.take(above) for along in (x, y, z)))
    counts = np.zeros(len(above), np.float32)
    for nearest in _table_of_rays():
        met = np.abs(patches.arrivals.reshape(-1).take(4 * (first_ray + nearest.take(cells)) + 3))
        counts += (met == 0) | (met >= far)
    visible = np.zeros_like(cosines)
    visible.reshape(-1)[above] = counts / NEAREST_RAYS
    return cosines * area / (np.float32(np.pi) * squared + area), visible


def _cells(x: Singles, y: Singles, z: Singles) -> Ints:
    """[n] cells of _table_of_rays of directions of any length, [n] each.

    On the octahedron |x| + |y| + |z| = 1, whose lower half is folded outward.
    """
    size = np.abs(x) + np.abs(y) + np.abs(z)
    first, second = x / size, y / size
    folded = np.copysign(1 - np.abs(second), first), np.copysign(1 - np.abs(first), second)
    first, second = np.where(z < 0, folded[0], first), np.where(z < 0, folded[1], second)
    row, column = (np.clip((along + 1) * (TABLE / 2), 0, TABLE - 1).astype(np.int64) for along in (first, second))
    return np.asarray(TABLE * row + column)


@cache
def _table_of_rays() -> Ints:
    """[NEAREST_RAYS, TABLE^2] numbers of the ray_directions nearest to the middle of each cell, 3 degrees wide."""
    steps = (np.arange(TABLE) + 0.5) * 2 / TABLE - 1
    first, second = (side.ravel() for side in np.meshgrid(steps, steps, indexing="ij"))
    z = 1 - np.abs(first) - np.abs(second)
    outward = np.maximum(-z, 0.0)
    directions = np.stack([first - np.copysign(outward, first), second - np.copysign(outward, second), z], axis=-1)
    directions /= np.linalg.norm(directions, axis=-1, keepdims=True)
    return np.ascontiguousarray(KDTree(ray_directions()).query(directions, NEAREST_RAYS)[1].T)
