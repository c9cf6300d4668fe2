"""The shell: a closed box around a room's scan and its cameras, whose cells send the light that is not scanned surface.

A ray that leaves the scan ends where it meets the box, so light from 2 m away is not taken for distant light. The box
is aligned with gravity and with the walls that were seen.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

SIDE = 7
"""Cells along an edge of a face: of half a metre in a room. With 5 to 9, rooms' medians change by a degree or two
(docs/light_experiments.md)."""
SIDES = 6
"""In the order -x, +x, -y, +y, -z, +z of the shell's axes."""
CELLS = SIDES * SIDE * SIDE
FLOOR = slice(4 * SIDE * SIDE, 5 * SIDE * SIDE)
"""The cells of its floor."""
CORNERS = 4
"""Number of cells between which a point of the shell is interpolated."""
LEAST_HEIGHT_M = 2.4
"""A ceiling is at least this high above the floor."""
BEHIND_M = 1.0
"""A wall that is not scanned is at least this far from a camera."""
CAMERA_M = 0.05
"""A wall that is scanned is at least this far from a camera."""
WALL_M = 0.3
"""Depth range of the surface of one wall, with the things that hang on it and with bends of the scan."""
CLOSED_M2 = 0.15
"""A side with at least this area of scanned wall is closed: more than furniture or stray depth that faces the same
way. It closes little by little: while each patch closed .15 of a side at once, a side of the real kitchen's first
picture was open in one volume and .45 closed in another."""
BEHIND_WALL = 0.03
"""Share of the surface that may lie farther out than a wall by more than WALL_M: stray depth, and what is seen through
a door. With twice as much it is no wall."""
INWARD = 0.7, 0.95
"""Cosine to a side's normal: surface up to the first is none of its wall, from the second on all of it. Normals of a
wall in the first picture are off by 30 degrees here and there."""
LAMPS_ABOVE_M = 1.0
"""Height over the floor above which windows and lamps are expected."""
_NOISE_M = 0.1  # the box moves only where a side does by more
_UPWARD = 0.9  # least cosine to the vertical of floor
_MOST_TILT_DEG = 60.0  # of floors and tables to the given up direction: beyond are walls
_UP_WEIGHT = 5.0  # patches that the given up direction counts as
_OUTLIERS = 0.002  # share of positions along an axis that may lie outside, on either side: stray depth

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Shell:
    """A box in world space."""

    axes: Floats
    """[3, 3] rows: two horizontal directions along walls, and up."""
    low: Floats
    """[3] metres along `axes`."""
    high: Floats
    floor_m: float
    """Height of the lowest surface that was scanned, along `axes[2]`."""
    cameras: Floats
    """[2, 3] the lowest and highest place of a camera along `axes`."""

    def distances(self, points: Floats, directions: Floats) -> Floats:
        """[..., 3] metres along rays from `points` [..., 3] inside of it to the faces across each axis."""
        return _distances(self.low, self.high, points @ self.axes.T, directions @ self.axes.T)

    def exits(self, points: Floats, directions: Floats) -> tuple[NDArray[np.int64], Floats]:
        """[..., CORNERS] cells, and their shares, by which rays from `points` [..., 3] inside of it end on it.

        Radiance is bilinear between the middles of a face's cells, and even beyond the outermost ones. directions:
        [..., 3].
        """
        # An axis at a time: numbers that lie beside each other are gone through twice as fast.
        origin, direction = (self.axes @ rays.reshape(-1, 3).T for rays in (points, directions))
        sides = zip(self.low, self.high, origin, direction, strict=True)
        x, y, z = (_distances(low, high, *along) for low, high, *along in sides)
        axis = np.where((x <= y) & (x <= z), 0, np.where(y <= z, 1, 2))
        end = origin + np.minimum(np.minimum(x, y), z) * direction
        size = (self.high - self.low)[:, None]
        place = np.clip((end - self.low[:, None]) / size * SIDE - 0.5, 0.0, SIDE - 1 - 1e-9)
        is_high = np.choose(axis, direction > 0)
        across, along = np.where(axis == 0, place[1], place[0]), np.where(axis == 2, place[1], place[2])
        row, column = across.astype(np.int64), along.astype(np.int64)
        first, second = across - row, along - column
        cell = ((2 * axis + is_high) * SIDE + row) * SIDE + column
        both = first * second
        shares = np.stack([1 - first - second + both, second - both, first - both, both], axis=-1)
        cells, shape = cell[:, None] + np.array([0, 1, SIDE, SIDE + 1]), (*points.shape[:-1], CORNERS)
        return cells.reshape(shape), shares.reshape(shape)

    def has_size_of(self, other: Shell) -> bool:
        """Whether both are the same box."""
        mine, others = (self.axes, self.low, self.high), (other.axes, other.low, other.high)
        return all(np.array_equal(one, two) for one, two in zip(mine, others, strict=True))

    @cached_property
    def centers(self) -> Floats:
        """[CELLS, 3] middles of the cells along `axes`, metres."""
        share = np.empty((6, SIDE, SIDE, 3))
        steps = (np.arange(SIDE) + 0.5) / SIDE
        for face in range(6):
            first, second = _other_axes(face // 2)
            share[face, :, :, face // 2] = face % 2
            share[face, :, :, first] = steps[:, None]
            share[face, :, :, second] = steps[None, :]
        return np.asarray(self.low + share.reshape(-1, 3) * (self.high - self.low))

    @cached_property
    def blur_m2(self) -> Floats:
        """[SIDES] by how much bilinear radiance on a face is wider than what lights it: variance along both axes.

        A lamp smaller than a cell becomes the cell's tent, whose variance is a sixth of the square of its size.
        """
        squares = ((self.high - self.low) / SIDE) ** 2 / 6
        return np.repeat(squares.sum() - squares, 2)

    def is_on_floor(self, positions: Floats, normals: Floats) -> NDArray[np.bool_]:
        """[n] whether patches at `positions` [n, 3] that face `normals` [n, 3], world, are of the scanned floor."""
        return np.asarray((normals @ self.axes[2] > _UPWARD) & (positions @ self.axes[2] < self.floor_m + WALL_M))

    @cached_property
    def is_low(self) -> NDArray[np.bool_]:
        """[CELLS] cells below the height of windows and lamps."""
        return np.asarray(self.centers[:, 2] < self.floor_m + LAMPS_ABOVE_M)


def _distances(low: Floats, high: Floats, origin: Floats, direction: Floats) -> Floats:
    with np.errstate(divide="ignore", invalid="ignore"):
        distance = np.where(direction > 0, high - origin, low - origin) / direction
    return np.asarray(np.where(np.isfinite(distance), distance, np.inf))


def upright(normals: Floats, up: Floats) -> Floats:
    """[3] the direction that floors and tables face: the mode of `normals` [n, 3] near `up` [3], up to 30 degrees off.

    A mean shift on the sphere, from a wide window to a narrow one; `up` itself counts in the widest.
    """
    found, normals = up, normals[normals @ up > np.cos(np.radians(_MOST_TILT_DEG))]
    for width_deg in (30.0, 15.0, 8.0):
        sharpness = 1 / np.radians(width_deg) ** 2
        for _ in range(4):
            weights = np.exp(sharpness * (normals @ found - 1))
            mean = weights @ normals + _UP_WEIGHT * up * (width_deg > 20 or weights.sum() < 1)
            found = mean / np.linalg.norm(mean)
    return np.asarray(found)


def wall_axes(normals: Floats, up: Floats) -> Floats:
    """[3, 3] rows of Shell.axes: the horizontal direction that most walls face along or across, its normal, and up.

    The mean of the fourth power of the horizontal normals, as complex numbers, has four times the walls' angle.
    normals: [n, 3] of surface, unit; up: [3] unit.
    """
    across = np.eye(3)[np.argmin(np.abs(up))]
    first = across - (across @ up) * up
    first /= np.linalg.norm(first)
    second = np.cross(up, first)
    fourth: complex = complex(np.sum((normals @ first + 1j * (normals @ second)) ** 4))
    angle = np.angle(fourth) / 4
    along = np.cos(angle) * first + np.sin(angle) * second
    return np.stack([along, np.cross(up, along), up])


def closed_sides(
    positions: Floats, normals: Floats, axes: Floats, patch_m2: float, *, has_walls: bool = True
) -> Floats:
    """[SIDES] how far each side of a room is scanned wall, from 0, open, to 1; no patch changes it by a jump.

    positions, normals: [n, 3] of patches, world, that stand for `patch_m2` of surface each; a side is closed by those
    at the end of the scan that face into the room. has_walls: else upright surface is of things on a table, and closes
    nothing.
    """
    surface, facing = positions @ axes.T, normals @ axes.T
    closed = np.zeros(SIDES)
    for side in range(SIDES):
        axis, is_high = divmod(side, 2)
        outward = 1 if is_high else -1
        place, inward = outward * surface[:, axis], -outward * facing[:, axis]
        is_wall = _step((inward - INWARD[0]) / (INWARD[1] - INWARD[0]))
        if is_wall.any() and (has_walls or axis == 2):
            is_wall *= _step(2 - _share_behind(place) / BEHIND_WALL)
            closed[side] = _step(is_wall.sum() * patch_m2 / CLOSED_M2)
    return closed


def _share_behind(place: Floats) -> Floats:
    """[n] the share of surface at `place` [n], metres outward, that lies farther out than each by WALL_M.

    It counts from half of that on, and all of it from one and a half times as much: with F(x) the share farther out
    than x, the mean of F between both, which is a difference of F's integrals.
    """
    ends = np.sort(place)[::-1]
    sums = np.concatenate([[0.0], np.cumsum(ends)])

    def integral(x: Floats) -> Floats:
        farther = np.searchsorted(-ends, -x)
        return np.asarray((sums[farther] - farther * x) / len(place))

    return (integral(place + 0.5 * WALL_M) - integral(place + 1.5 * WALL_M)) / WALL_M


def _step(x: Any) -> Any:
    """From 0 at 0 to 1 at 1, with slope 0 at both."""
    x = np.clip(x, 0.0, 1.0)
    return x * x * (3 - 2 * x)


def room_axes(normals: Floats, up: Floats, before: Shell | None) -> Floats:
    """[3, 3] Shell.axes: those of the last shell, or by surface that faces `normals` [n, 3]; up: [3] unit, world."""
    return wall_axes(normals, upright(normals, up)) if before is None else before.axes


def shell_around(positions: Floats, cameras: Floats, axes: Floats, closed: Floats, before: Shell | None) -> Shell:
    """The shell around `positions` [n, 3] of surface and `cameras` [m, 3], world metres.

    axes: of room_axes; closed: [SIDES] of closed_sides. before: the last one, returned unless the shell has changed by
    more than noise makes.
    """
    low, high = _ends(positions @ axes.T)
    floor_m = float(low[2])
    seen_from = cameras @ axes.T
    if before is not None:
        seen_from = np.concatenate([seen_from, before.cameras])
    open_share = 1.0 - closed.reshape(3, 2).T
    reach = CAMERA_M + np.array([BEHIND_M, BEHIND_M, 0.0]) * open_share
    seen = np.stack([seen_from.min(0), seen_from.max(0)])
    low, high = np.minimum(low, seen[0] - reach[0]), np.maximum(high, seen[1] + reach[1])
    high[2] = max(high[2], floor_m + LEAST_HEIGHT_M)
    if before is not None and max(np.abs(low - before.low).max(), np.abs(high - before.high).max()) < _NOISE_M:
        return before
    return Shell(axes, low, high, floor_m, seen)


def _ends(surface: Floats) -> Floats:
    """[2, 3] where surface [n, 3] begins and ends along the axes, without stray depth."""
    return np.quantile(surface, (_OUTLIERS, 1 - _OUTLIERS), axis=0)


def neighbours() -> NDArray[np.int64]:
    """[k, 2] pairs of cells that share an edge, on all faces and across the edges of the box."""
    cells = np.arange(CELLS).reshape(6, SIDE, SIDE)
    pairs = [np.stack([cells[:, :-1].ravel(), cells[:, 1:].ravel()], 1)]
    pairs.append(np.stack([cells[:, :, :-1].ravel(), cells[:, :, 1:].ravel()], 1))
    for face in range(6):
        for other in range(face + 1, 6):
            if face // 2 != other // 2:
                pairs.append(np.stack([_border(cells, face, other), _border(cells, other, face)], 1))
    return np.concatenate(pairs)


def _other_axes(axis: int) -> tuple[int, int]:
    first, second = (other for other in range(3) if other != axis)
    return first, second


def _border(cells: NDArray[np.int64], face: int, other: int) -> NDArray[np.int64]:
    """[SIDE] cells of `face` along its edge with `other`."""
    end = -1 if other % 2 else 0
    row: NDArray[np.int64] = cells[face, end] if _other_axes(face // 2)[0] == other // 2 else cells[face, :, end]
    return row
