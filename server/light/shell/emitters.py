"""Sources that are small and have a place, towards which rays of their own go."""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.distance import cdist

from server.light.shell.patches import GRIDS, Patches
from server.light.shell.weights import GIVEN_ALBEDO
from server.maths.distinct_rows import distinct_rows
from server.volume.volume import Volume

CELL_M = 0.3
"""Side of the grid's cells: half a window pane. From a metre away its light comes from one direction."""
ENOUGH_RAYS = 4.0
"""Number of evenly spread rays that meet an emitter from which on their count is better than one ray to its middle."""
NEARBY_M = 0.25
"""Surface within this distance (standard deviation) is taken to receive the same light."""
UNLIT, LIT = 0.25, 0.5
"""Ratio of the light that arrives nearby to the light that a saturated surface sends. Below the first value the surface
is a lamp; above the second, it may be bright paint in that light."""

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]


@dataclass(frozen=True)
class Emitters:
    """Cells of saturated surface at one frame, and lamps that no picture has shown. [k], world axes and metres."""

    keys: NDArray[np.int64]
    """[k, 3] of the grid of CELL_M; of lamps, their number first."""
    centers: Floats
    """[k, 3]."""
    facing: Floats
    """[k, 3] unit."""
    flatness: Floats
    """[k] from 0, sends evenly in all directions, to 1, a plane that sends to its front as its cosine."""
    areas_m2: Floats
    """[k] as seen from the front."""
    radiance: Floats
    """[k, 3] as clipped; of lamps, as what is clipped."""
    presence: Floats
    """[k] from 0 to 1: how far it counts."""
    is_unseen: NDArray[np.bool_]
    """[k] lamps that no picture has shown (unseen_lamps.py), not saturated surface."""

    @property
    def count(self) -> int:
        """Number of emitters."""
        return len(self.areas_m2)

    def only(self, chosen: Ints) -> Emitters:
        """Those of the numbers `chosen` [m]."""
        return Emitters(**{part.name: getattr(self, part.name)[chosen] for part in fields(self)})

    def and_(self, others: Emitters) -> Emitters:
        """These, then `others`."""
        parts = {part.name: (getattr(self, part.name), getattr(others, part.name)) for part in fields(self)}
        return Emitters(**{name: np.concatenate(both) for name, both in parts.items()})

    def directions_from(self, points: Floats) -> Floats:
        """[n, k, 3] unit, from `points` [n, 3]."""
        return np.asarray((self.centers[None] - points[:, None]) / self.seen_from(points)[0][..., None])

    def seen_from(self, points: Floats) -> tuple[Floats, Floats]:
        """Distances [n, k] from `points` [n, 3] and areas across the line of sight [n, k]."""
        distances = np.maximum(cdist(points, self.centers), 1e-6)
        cosines = np.maximum(points @ self.facing.T - (self.centers * self.facing).sum(axis=1), 0.0) / distances
        return distances, self.areas_m2 * ((1 - self.flatness) + self.flatness * cosines)

    def shares(self, points: Floats, normals: Floats) -> Floats:
        """[n, k] that emitters fill of the cosine-weighted hemispheres of `points` with unit `normals`, [n, 3] each."""
        distances, areas = self.seen_from(points)
        cosines = np.maximum(normals @ self.centers.T - (normals * points).sum(axis=1)[:, None], 0.0) / distances
        return np.asarray(cosines * areas / (np.pi * distances**2 + areas))

    def lit_by(self, patches: Patches, up: Floats) -> Floats:
        """[k] from 0 to 1: how far the light on surface nearby that faces alike explains what each sends.

        Flat surface that faces up is lit: a table, a floor. up: [3] unit, world.
        """
        rows = patches.used[patches.clipped[patches.used] < 0.5]
        near = np.exp(-cdist(self.centers, patches.positions[rows], "sqeuclidean") / (2 * NEARBY_M**2))
        alike = np.maximum(self.facing @ patches.normals[rows].T, 0.0) ** 2 * near
        shown = np.exp(patches.logarithms[rows].mean(axis=1))
        dark_patches = GRIDS  # far from all patches, no light arrives
        arriving = alike @ shown / (alike.sum(axis=1) + dark_patches) / GIVEN_ALBEDO
        share = arriving / np.maximum(self.radiance.mean(axis=1), 1e-6)
        lit = np.clip((share - UNLIT) / (LIT - UNLIT), 0.0, 1.0)
        return np.asarray(self.flatness * np.maximum(lit, np.clip(2 * self.facing @ up - 1, 0.0, 1.0)))

    def solid_angles(self, points: Floats) -> Floats:
        """[n, k] steradians."""
        distances, areas = self.seen_from(points)
        return np.asarray(areas / (distances**2 + areas / (2 * np.pi)))

    def weights(self, shares: Floats, rays: int) -> Floats:
        """[n, k] how far a ray to each emitter counts, not evenly spread `rays`, of which `shares` [n, k] meet it."""
        return np.asarray(self.presence / (1 + np.where(self.is_unseen, 0.0, shares) * rays / ENOUGH_RAYS))

    def left_to_others(self, weights: Floats, rows: Ints, ends: Floats) -> Floats:
        """[m] how far rays count that meet saturated surface at `ends` [m, 3]; weights: [n, k], and whose row of it."""
        numbers = {tuple(key): number for number, key in enumerate(self.keys.tolist()) if not self.is_unseen[number]}
        found, inverse = distinct_rows(keys_of(ends))
        number = np.array([numbers.get(tuple(key), -1) for key in found.tolist()], np.int64)[inverse]
        result = np.ones(len(ends))
        own = number >= 0
        result[own] -= weights[rows[own], number[own]]
        return result

    def visible(self, volume: Volume, points: Floats, arrivals: NDArray[np.float32]) -> NDArray[np.bool_]:
        """[n, k] whether nothing stands between `points` [n, 3] and an emitter. arrivals: [n, k, 4] what rays towards
        the emitters met, as of trace_arrivals."""
        distances, areas = self.seen_from(points)
        met = np.abs(arrivals[..., 3])
        # What is as near to its middle is the emitter itself; one that was not seen has no surface.
        own = np.where(self.is_unseen, 0.0, np.sqrt(areas) + 2 * volume.voxel_m)
        return np.asarray((met == 0) | (met >= distances - own))

    def lamp_met(self, eye: Floats, directions: Floats, distances: NDArray[np.floating]) -> Ints:
        """[m] which lamp that no picture has shown rays from `eye` [3] along unit `directions` [m, 3] meet; -1: none.

        distances: [m] metres to the surface that they meet, 0 where there is none.
        """
        result, nearest = np.full(len(directions), -1), np.where(distances > 0, distances, np.inf)
        for number in np.flatnonzero(self.is_unseen):
            towards = self.centers[number] - eye
            ahead = directions @ towards
            aside = towards @ towards - ahead**2
            is_met = (ahead > 0) & (ahead < nearest) & (np.pi * aside < self.areas_m2[number])
            result[is_met], nearest[is_met] = number, ahead[is_met]
        return result


@dataclass(frozen=True)
class EmittersSeen:
    """Emitters and which patches see them."""

    emitters: Emitters
    visible: Floats
    """[MOST_PATCHES, k] 1 or 0."""


def keys_of(points: Floats) -> Ints:
    """[n, 3] cells of saturated surface at points [n, 3]."""
    return np.asarray(np.floor(points / CELL_M).astype(np.int64))
