"""A moving hand of capsules: it enters over the table, waves, and leaves; with mutual shadows.

Its shadow on static solids is integrated in every frame, on a coarser grid and with fewer directions than static
shadows; the hand hovers, so its shadow is soft. The visibility of static solids is precomputed as bits, so that
directions that they block are not counted twice.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from client.synthetic.lighting.bake import bake, blocked_directions, tiles
from client.synthetic.lighting.harmonics import sphere_directions
from client.synthetic.lighting.lights import DistantLight
from client.synthetic.scenes.textures import painted
from client.synthetic.solids.charts import Grid, atlas
from client.synthetic.solids.polyhedra import Solid, rotation_about
from client.synthetic.solids.round import Capsule

DIRECTIONS, SKIN_DIRECTIONS = 1024, 512
SHADOW_STEP_M = 0.016
"""Distance between samples of the hand's shadow on static surfaces."""
SKIN_STEP_M = 0.008
"""Distance between samples of shadows on the hand."""
SKIN = painted(0.68, 0.44, 0.34)

ENTER, STAY, LEAVE, GONE = 0.15, 0.35, 0.7, 0.9
"""Start of each phase, as a fraction of the sequence."""
WAVES = 2.5
"""Number of waves while it stays."""
STAY_POSITION = np.array([0.12, 0.25, 0.2])
"""World position of the palm while it stays."""
OUT_OF_SIGHT_OFFSET = np.array([0.95, 0.06, 0.12])
"""Offset from there to a position out of sight."""

_FINGERS = (  # of a right hand pointing to -x, palm down: root in the palm's frame, splay in degrees, length, radius
    ((-0.05, 0.0, -0.033), -9.0, 0.062, 0.0085),
    ((-0.055, 0.0, -0.011), -3.0, 0.075, 0.0095),
    ((-0.055, 0.0, 0.012), 3.0, 0.078, 0.0095),
    ((-0.05, 0.0, 0.034), 9.0, 0.068, 0.009),
    ((0.0, -0.004, 0.045), 48.0, 0.062, 0.0105),
)


def capsules(progress: float) -> list[Capsule]:
    """Capsules of the hand at `progress` (0 to 1) of the sequence; empty while it is out of sight."""
    presence = _presence(progress)
    if presence <= 0:
        return []
    staying = np.clip((progress - STAY) / (LEAVE - STAY), 0, 1)
    swing = np.sin(2 * np.pi * WAVES * staying) * np.sin(np.pi * staying)
    rotation = rotation_about("y", 22 * swing) @ rotation_about("z", -8) @ rotation_about("x", 15 * swing)
    palm = STAY_POSITION + (1 - presence) * OUT_OF_SIGHT_OFFSET + np.array([0.0, 0.015 * swing, 0.07 * swing])

    def part(start: tuple[float, float, float], end: tuple[float, float, float], radius: float) -> Capsule:
        return Capsule(palm + rotation @ np.array(start), palm + rotation @ np.array(end), radius)

    hand = [part((0.035, 0, z), (-0.04, 0, z * 1.1), 0.017) for z in (-0.028, -0.009, 0.01, 0.029)]
    for root, splay, length, radius in _FINGERS:
        away = rotation_about("y", splay) @ np.array([-length, -0.1 * length, 0])
        hand.append(part(root, tuple(np.array(root) + away), radius))
    wrist = palm + rotation @ np.array([0.05, 0, 0])
    elbow = wrist + np.array([0.55, 0.08, 0.06]) + 0.25 * (palm - STAY_POSITION) * np.array([0, 0, 1])
    return [*hand, Capsule(wrist, elbow, 0.032)]


def _presence(progress: float) -> float:
    """0: out of sight, 1: in place."""
    x = np.clip(min((progress - ENTER) / (STAY - ENTER), (GONE - progress) / (GONE - LEAVE)), 0, 1)
    return float(x * x * (3 - 2 * x))


@dataclass(frozen=True)
class _Piece:
    """Neighbouring samples of one chart."""

    solid: Solid
    samples: NDArray[np.intp]
    """[n] indices in the table."""
    points: NDArray[np.float32]
    """[n, 3] world metres."""
    normals: NDArray[np.float32]
    """[n, 3], or [1, 3] on a flat face."""


class StaticVisibility:
    """Directions not blocked by static solids, at samples on their surfaces."""

    def __init__(self, solids: list[Solid], open_bits: NDArray[np.uint8] | None = None) -> None:
        self.solids = solids
        self.grids = atlas([solid.charts for solid in solids], SHADOW_STEP_M)
        self.directions = sphere_directions(DIRECTIONS).astype(np.float32)
        self.size = self.grids[-1][-1].offset + self.grids[-1][-1].size
        self._pieces = list(self._cut())
        self.open_bits = self._compute() if open_bits is None else open_bits

    def shadow(self, hand: list[Capsule], light: DistantLight) -> NDArray[np.float32]:
        """[total, 3] irradiance / pi that only the hand blocks at every sample."""
        blocked_light = np.zeros((self.size, 3), np.float32)
        weights = light.radiance(self.directions) * np.float32(4 / DIRECTIONS)
        for piece in self._pieces:
            cosines = np.maximum(piece.normals @ self.directions.T, 0)
            parts = [part for part in hand if _is_above(part, piece)]
            blocked = blocked_directions(parts, None, piece.points, self.directions, cosines.any(axis=0))
            hit = np.flatnonzero(blocked.any(axis=0))
            if hit.size:
                is_open = np.unpackbits(self.open_bits[piece.samples], axis=1)[:, hit]
                blocked_light[piece.samples] = (blocked[:, hit] * is_open * cosines[:, hit]) @ weights[hit]
        return blocked_light

    def _cut(self) -> Iterator[_Piece]:
        for solid, grids in zip(self.solids, self.grids, strict=True):
            for grid in grids:
                positions, normals = grid.samples()
                numbers = grid.offset + np.arange(grid.size).reshape(grid.rows, grid.columns)
                for tile in tiles(grid, DIRECTIONS):
                    up = normals[tile].reshape(-1, 3).astype(np.float32)
                    points = positions[tile].reshape(-1, 3).astype(np.float32)
                    yield _Piece(solid, numbers[tile].ravel(), points, up[:1] if grid.is_flat else up)

    def _compute(self) -> NDArray[np.uint8]:
        bits = np.zeros((self.size, DIRECTIONS // 8), np.uint8)
        for piece in self._pieces:
            blocked = blocked_directions(self.solids, piece.solid, piece.points, self.directions)
            bits[piece.samples] = np.packbits(~blocked, axis=1)
        return bits


def _is_above(part: Capsule, piece: _Piece) -> bool:
    """Whether part of the capsule may be above the horizon of a flat piece; True for curved ones."""
    center, radius = part.bounds
    return len(piece.normals) > 1 or bool((center - piece.points[0]) @ piece.normals[0] > -radius)


def skin_shadows(hand: list[Capsule], static: list[Solid]) -> tuple[list[list[Grid]], NDArray[np.float32]]:
    """Grids over the hand, and [total, 16] occluded transfer there, by static solids and other parts of the hand."""
    grids = atlas([part.charts for part in hand], SKIN_STEP_M)
    return grids, bake([*hand, *static], grids, sphere_directions(SKIN_DIRECTIONS).astype(np.float32))
