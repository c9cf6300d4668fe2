"""Whether the light has changed between two frames, by surface that both show.

Under one light the same surface shows the same radiance, whatever its albedo, its shape and the model of the light: so
what two frames show of it tells a change of the light from a change of view. A new light changes the logarithm of
radiance with the normal and the place, r = a + b n + c p + noise; texture, met a little off, is noise.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

CELL_M = 0.08
"""Side of the cells in which surface of two frames is the same."""
LEAST_SHARED = 40
"""Cells that two frames must share to tell."""
LEAST_CHANGE = 0.012
"""Root mean square change of log radiance that is a change of the light, from one point of view. A light that turns by
1.2 degrees a frame takes two or three frames to it."""
CHANGE_OF_VIEW = 0.6
"""What is allowed besides for a change of view by 1 (radians, and distances to what is seen): gloss, vignetting,
texture met beside itself. 97 of 100 pairs of a real recording under one light stay below."""
CHANGE_OF_EXPOSURE = 1.0
"""The same for a change of the exposure's logarithm by 1: cameras are not quite linear."""
LEAST_EVIDENCE = 25.0
"""And of its square over its variance (chi-square of 7): beyond what noise makes."""
_LEAST_WEIGHT, _LEAST_RADIANCE = 0.2, 1e-3
_DEPENDENCE = 4.0  # cells that err alike
_LEAST_SCATTER = 0.01
_RIDGE = 1.0  # of what is fitted to a picture whose surfaces all face one way
_ROUNDS = 8

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Shot:
    """Where and how a frame was taken."""

    volume_from_camera: Floats
    """[4, 4]."""
    exposure: float = 1.0
    """Its factor, which radiance is already without."""


@dataclass(frozen=True)
class Shown:
    """What a frame shows of which surface, a row a cell."""

    cells: NDArray[np.int64]
    """[n] place and side of the surface, sorted."""
    levels: Floats
    """[n] logarithm of its luminance."""
    normals: Floats
    positions: Floats
    """[n, 3] volume space, metres."""
    shot: Shot


@dataclass(frozen=True)
class Change:
    """What two frames say of a change of the light."""

    size: float
    """Root mean square change of log radiance over the surface that both show."""
    evidence: float
    """Its square over its variance; 0 where the frames share too little."""
    allowed: float = LEAST_CHANGE
    """What of it a change of view may make."""

    @property
    def is_certain(self) -> bool:
        """Whether the light has changed."""
        return self.size > self.allowed and self.evidence > LEAST_EVIDENCE

    @property
    def kept_weight(self) -> float:
        """What weight the older frame keeps: a third after the least change, hardly any after a great one."""
        return float(np.exp(-self.size / self.allowed))


def surface_cells(positions: Floats, normals: Floats, side_m: float) -> NDArray[np.int64]:
    """[n] a number for the cell that each of `positions` [n, 3] lies in and the axis its normal is nearest to."""
    at = np.floor(positions / side_m).astype(np.int64) & 0xFFFFF
    axis = np.abs(normals).argmax(axis=1)
    face = 2 * axis + (normals[np.arange(len(normals)), axis] > 0)
    return np.asarray(((at[:, 0] << 20 | at[:, 1]) << 20 | at[:, 2]) << 3 | face)


def shown_by(luminance: Floats, weights: Floats, positions: Floats, normals: Floats, shot: Shot) -> Shown:
    """What pools show: luminance [n] linear, weights [n] 0 to 1, positions and normals [n, 3]."""
    used = (weights > _LEAST_WEIGHT) & (luminance > _LEAST_RADIANCE)
    cells, first = np.unique(surface_cells(positions[used], normals[used], CELL_M), return_index=True)
    levels = np.log(luminance[used][first])
    return Shown(cells, levels, normals[used][first], positions[used][first], shot)


def change_between(older: Shown, newer: Shown) -> Change:
    """How the light of `newer` differs from that of `older`, as far as surface that both show tells."""
    shared, old, new = np.intersect1d(older.cells, newer.cells, assume_unique=True, return_indices=True)
    if len(shared) < LEAST_SHARED:
        return Change(0.0, 0.0)
    ratio = newer.levels[new] - older.levels[old]
    columns = np.column_stack([_centered(older.normals[old]), _centered(older.positions[old])])
    columns[:, 3:] /= max(float(columns[:, 3:].std()), 1e-3)
    columns = np.column_stack([np.ones(len(shared)), columns])
    ridge = np.diag([1e-9, *[_RIDGE] * 6])
    weights: Floats = np.ones(len(shared))
    scatter = 1.0
    amounts: Floats = np.zeros(7)
    matrix: Floats = ridge
    for _ in range(_ROUNDS):
        matrix = columns.T @ (weights[:, None] * columns) + ridge
        amounts = np.asarray(np.linalg.solve(matrix, columns.T @ (weights * ratio)), np.float64)
        apart = np.abs(ratio - columns @ amounts)
        scatter = 1.4826 * float(np.median(apart)) + _LEAST_SCATTER
        weights = np.asarray(1.0 / (1.0 + (apart / (2.0 * scatter)) ** 2), np.float64)
    size = float(np.sqrt(np.average((columns @ amounts) ** 2, weights=weights)))
    evidence = float(amounts @ matrix @ amounts) / (_DEPENDENCE * scatter**2)
    return Change(size, evidence, LEAST_CHANGE + _other_changes(older.shot, newer.shot, newer.positions[new]))


def _other_changes(older: Shot, newer: Shot, positions: Floats) -> float:
    """What may make the same surface, at `positions` [n, 3], look otherwise under the same light."""
    a, b = older.volume_from_camera, newer.volume_from_camera
    turned = float(np.arccos(np.clip((np.trace(a[:3, :3].T @ b[:3, :3]) - 1) / 2, -1, 1)))
    far = float(np.median(np.linalg.norm(positions - b[:3, 3], axis=1)))
    view = turned + float(np.linalg.norm(a[:3, 3] - b[:3, 3])) / max(far, 1e-3)
    return CHANGE_OF_VIEW * view + CHANGE_OF_EXPOSURE * abs(float(np.log(newer.exposure / older.exposure)))


def _centered(rows: Floats) -> Floats:
    return np.asarray(rows - rows.mean(axis=0))
