"""Planes in oriented points, and how far each goes on beyond what was seen of it."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Indices = NDArray[np.int64]

CELL_M = 0.05
"""Side of a cell of a plane's map."""
REACH_M = 3.2
"""A plane is followed so far beyond the first points seen of it."""
STEPS_M = (0.0, 0.1, 0.2, 0.3, 0.45, 0.6, 0.8, 1.0, 1.3, 1.7, 2.2, 3.0)
"""How far a plane may go on beyond each of its four sides."""
_GRID_M = 0.05  # all of them are multiples
_ROUNDING = np.float32(1e-4)
_STEP_OF = np.searchsorted(np.array(STEPS_M) + 1e-6, _GRID_M * np.arange(round(STEPS_M[-1] / _GRID_M) + 2)).astype(
    np.uint8
)
SIDES = 4
_THICKNESS_M = 0.02
_LEAST_SHARE = 0.02
_ALIKE = 0.95  # cosine between a point's normal and its plane's
_UPRIGHT = 0.2  # cosine between normals of planes that meet at about a right angle
_TRIALS = 48
_MOST = 8


@dataclass
class PlanePatch:
    """A plane, what was seen of it and what of it cannot be."""

    normal: Floats
    """[3] unit, towards the room."""
    offset_m: float
    """Of the plane from the origin, along the normal."""
    across: Floats
    along: Floats
    """[3] unit, in the plane."""
    corner: Floats
    """[2] coordinates across and along of the map's first cell's outer edge, metres."""
    empty: NDArray[np.bool_]
    """[rows along, cols across] cells that a camera looked through."""
    seen: Floats
    """[2, 2] first and last coordinates of what was seen, relative to `corner`."""
    steps: NDArray[np.int64] = field(default_factory=lambda: np.zeros(SIDES, np.int64))
    """[4] index into STEPS_M beyond lower across, upper across, lower along, upper along."""

    @property
    def box(self) -> Floats:
        """[4] across from, to, along from, to: where the plane is taken to be, relative to `corner`."""
        (low_x, low_y), (high_x, high_y) = self.seen
        reach = np.array(STEPS_M)[self.steps]
        return np.array([low_x - reach[0], high_x + reach[1], low_y - reach[2], high_y + reach[3]])

    @property
    def longest_m(self) -> float:
        """The longer side of what was seen."""
        return float((self.seen[1] - self.seen[0]).max())

    def coordinates(self, points: Floats) -> Floats:
        """[..., 2] of points [..., 3] on the plane, relative to `corner`."""
        return np.stack([points @ self.across, points @ self.along], axis=-1) - self.corner

    def contains(self, points: Floats, normals: Floats) -> NDArray[np.bool_]:
        """[n] which of oriented points [n, 3] are of it."""
        near = np.abs(points @ self.normal - self.offset_m) < _THICKNESS_M
        return np.asarray(near & (normals @ self.normal > _ALIKE))

    def cell_centers(self) -> Floats:
        """[rows, cols, 3] of the map."""
        rows, cols = self.empty.shape
        x = self.corner[0] + (np.arange(cols) + 0.5) * CELL_M
        y = self.corner[1] + (np.arange(rows) + 0.5) * CELL_M
        on_axis = self.offset_m * self.normal
        return np.asarray(on_axis + x[None, :, None] * self.across + y[:, None, None] * self.along)

    def widen(self, points: Floats) -> None:
        """Count `points` [n, 3] of the plane as seen."""
        at = self.coordinates(points)
        self.seen = np.stack([np.minimum(self.seen[0], at.min(axis=0)), np.maximum(self.seen[1], at.max(axis=0))])

    def steps_needed(
        self, origins: Floats, directions: Floats, of_origins: Indices, of_directions: Indices, least_m: float
    ) -> NDArray[np.uint8]:
        """[SIDES, k] the least index into STEPS_M by which each side must go on for rays to meet the plane, farther off
        than `least_m`; len(STEPS_M) where that is not enough, they miss it, or a camera looked through.

        Rays: from those of `origins` [n, 3] along those of `directions` [m, 3] that `of_origins`, `of_directions` [k]
        name. To float32.
        """
        sinking = directions @ self.normal
        steep = np.abs(sinking) >= 1e-5
        per_metre = np.where(steep, 1 / np.where(steep, sinking, 1.0), 0.0).astype(np.float32)
        heights = (self.offset_m - origins @ self.normal).astype(np.float32)
        t = heights[of_origins] * per_metre[of_directions]
        ahead = np.flatnonzero(t >= np.float32(least_m))
        t, starts, slopes = t[ahead], of_origins[ahead], of_directions[ahead]
        x, y = (
            (origins @ axis - corner).astype(np.float32)[starts] + t * (directions @ axis).astype(np.float32)[slopes]
            for axis, corner in zip((self.across, self.along), self.corner, strict=True)
        )
        (low_x, low_y), (high_x, high_y) = self.seen.astype(np.float32)
        never = np.uint8(len(STEPS_M))
        least = never * self._is_empty_at(x, y).view(np.uint8)
        needed = np.full((SIDES, len(of_origins)), never)
        for side, over in enumerate((low_x - x, x - high_x, low_y - y, y - high_y)):
            steps = np.ceil(over * np.float32(1 / _GRID_M) - _ROUNDING)
            found = _STEP_OF.take(np.clip(steps, 0, len(_STEP_OF) - 1).astype(np.uint8))
            needed[side, ahead] = np.maximum(found, least)
        return needed

    def _is_empty_at(self, x: NDArray[np.float32], y: NDArray[np.float32]) -> NDArray[np.bool_]:
        """Of coordinates relative to `corner`; beyond the map, its nearest cell."""
        rows, cols = self.empty.shape
        col = np.clip(x * np.float32(1 / CELL_M), 0, cols - 1).astype(np.int32)
        row = np.clip(y * np.float32(1 / CELL_M), 0, rows - 1).astype(np.int32)
        return np.asarray(self.empty.ravel().take(row * np.int32(cols) + col))


def find_planes(points: Floats, normals: Floats, known: list[PlanePatch]) -> list[PlanePatch]:
    """The greatest planes of oriented points [n, 3], largest first; those of `known` that are found again keep what is
    known of them, and are widened. Deterministic."""
    rng = np.random.default_rng(0)
    left = np.ones(len(points), np.bool_)
    found: list[PlanePatch] = []
    for patch in known:
        own = left & patch.contains(points, normals)
        if own.sum() >= _LEAST_SHARE * len(points):
            patch.widen(points[own])
        found.append(patch)
        left &= ~own
    while len(found) < _MOST and left.sum() >= max(_LEAST_SHARE * len(points), 8):
        own = _largest(points, normals, left, rng)
        if own.sum() < max(_LEAST_SHARE * len(points), 8):
            break
        found.append(_patch(points[own], normals[own], [patch.normal for patch in found]))
        left &= ~own
    return found


def _largest(points: Floats, normals: Floats, left: NDArray[np.bool_], rng: np.random.Generator) -> NDArray[np.bool_]:
    """[n] points of the largest of the planes through some of those `left`."""
    best = np.zeros(len(points), np.bool_)
    for k in rng.choice(np.flatnonzero(left), _TRIALS):
        own = _of_plane(points, normals, normals[k], float(normals[k] @ points[k])) & left
        if own.sum() > best.sum():
            best = own
    if best.sum() < 3:
        return best
    normal, offset_m = _fit(points[best], normals[best])
    return _of_plane(points, normals, normal, offset_m) & left


def _of_plane(points: Floats, normals: Floats, normal: Floats, offset_m: float) -> NDArray[np.bool_]:
    return np.asarray((np.abs(points @ normal - offset_m) < _THICKNESS_M) & (normals @ normal > _ALIKE))


def _fit(points: Floats, normals: Floats) -> tuple[Floats, float]:
    """Unit normal and offset of the plane through `points` [n >= 3, 3]."""
    middle = points.mean(axis=0)
    normal = np.linalg.svd(points - middle, full_matrices=False)[2][2]
    normal = normal * (1.0 if normal @ normals.mean(axis=0) >= 0 else -1.0)
    return normal, float(normal @ middle)


def _patch(points: Floats, normals: Floats, others: list[Floats]) -> PlanePatch:
    """A new plane; its axes follow the first of the `others` that it stands on or against: there its edges are."""
    normal, offset_m = _fit(points, normals)
    axis = next((other for other in others if abs(other @ normal) < _UPRIGHT), np.eye(3)[np.abs(normal).argmin()])
    along = axis - (axis @ normal) * normal
    along /= np.linalg.norm(along)
    across = np.cross(along, normal)
    at = np.stack([points @ across, points @ along], axis=1)
    corner = at.min(axis=0) - REACH_M
    cols, rows = np.ceil((at.max(axis=0) - corner + REACH_M) / CELL_M).astype(int)
    seen = np.stack([at.min(axis=0) - corner, at.max(axis=0) - corner])
    return PlanePatch(normal, offset_m, across, along, corner, np.zeros((rows, cols), np.bool_), seen)
