"""Float64 twin of cl_kernels/shadow_map.cl, and the irradiance integral that it stands for (thesis 7.2.3).

The twin: percentage-closer soft shadows (Fernando 2005) over a pyramid that holds of each texel which part is covered
and the mean depth of that part. The integral: a far disc's light on a point, part by part, by brute force.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from server.maths.direct_lights import DirectLight

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]

COARSEST_SIDE = 8
SEARCH_RINGS = 5


def pyramid(covered: Bools, depths: Floats) -> list[tuple[Floats, Floats]]:
    """Covered part and mean depth of the covered part of every level [n, n], [n / 2, n / 2], ..."""
    levels = [(covered.astype(float), np.where(covered, depths, 0.0))]
    while len(levels[-1][0]) > COARSEST_SIDE:
        part, depth = levels[-1]
        blocks = [a.reshape(len(a) // 2, 2, len(a) // 2, 2).sum(axis=(1, 3)) for a in (part, part * depth)]
        levels.append((blocks[0] / 4, blocks[1] / np.where(blocks[0] > 0, blocks[0], 1)))
    return levels


@dataclass(frozen=True)
class Disc:
    """A disc's map: what `ShadowMaps` holds for one light. A near disc's map is in the space of direct_lights.clh."""

    levels: list[tuple[Floats, Floats]]
    axes: Floats
    """[3, 3] rows right, down, towards the light."""
    tangent: float
    ball: Floats
    """Middle and radius."""
    search: Floats
    places: Floats
    inverse_m: float = 0.0
    """1 / distance from the ball's middle; 0: it is distant."""
    half_m: float = 0.0
    """Half a side of the map; 0: the ball's radius."""

    def open_part(self, normals: Floats, point: Floats | None = None) -> Floats:
        """[n] what reaches open white surface at `point` (None: the ball's middle), over the irradiance there."""
        point = self.ball[:3] if point is None else point
        across = self._directions(point)
        right, down, away = self.axes @ (point - self.ball[:3]) * [1, 1, -1] * self.inverse_m
        return np.maximum(normals @ across.T, 0).mean(axis=1) / ((1 + away) ** 2 + right**2 + down**2)

    def free_part(self, point: Floats, normal: Floats, is_virtual: bool) -> float:
        """What objects leave of that at one point, 1 where it gets nothing."""
        raw, own = self.axes @ (point - self.ball[:3]) * [1, 1, -1], self.axes @ normal * [1, 1, -1]
        at = raw / (1 + self.inverse_m * raw[2])
        plane = own + self.inverse_m * (raw @ own) * np.eye(3)[2] if is_virtual else -np.eye(3)[2]
        lift_m = self._texel_m(0) if is_virtual else 0.0
        ahead = self._ahead(at, plane, lift_m)
        if ahead <= 0:
            return 1.0
        reach = max(ahead * self.tangent, self._texel_m(0) / 2)
        sides = 2 if is_virtual else 1
        apart = 0.36 * reach
        level = self._level(apart / sides)
        cosines = np.maximum(self._directions(point) @ normal, 0)
        steps = (np.arange(sides) - 0.5 * (sides - 1)) / sides * apart
        within = np.stack(np.meshgrid(steps, steps), axis=-1).reshape(-1, 2)
        covered = [
            np.mean([self._covered(at, plane, lift_m, level, reach * place + aside)[0] for aside in within])
            for place in self.places
        ]
        return float(1 - cosines @ covered / cosines.sum()) if cosines.sum() > 0 else 1.0

    def _directions(self, point: Floats) -> Floats:
        parts = self.axes[2] + self.tangent * (self.places @ self.axes[:2])  # from the ball's middle, over the distance
        across = parts - self.inverse_m * (point - self.ball[:3])
        return np.asarray(across / np.linalg.norm(across, axis=1, keepdims=True))

    def _texel_m(self, level: int) -> float:
        return 2 * (self.half_m or self.ball[3]) / len(self.levels[level][0])

    def _level(self, size_m: float) -> int:
        texels = np.clip(size_m / self._texel_m(0), 1, len(self.levels[0][0]) // COARSEST_SIDE)
        return int(np.log2(int(texels)))

    def _covered(self, at: Floats, plane: Floats, lift_m: float, level: int, aside: Floats) -> tuple[float, Floats]:
        part, depth = self.levels[level]
        texel_m = self._texel_m(level)
        col, row = np.floor((at[:2] + aside) / texel_m + len(part) / 2).astype(int)
        if not (0 <= col < len(part) and 0 <= row < len(part)):
            return 0.0, np.zeros(3)
        middle = (np.array([col, row]) + 0.5 - len(part) / 2) * texel_m
        offset = np.array([*middle, depth[row, col]]) - at
        above = plane @ offset > lift_m + texel_m / 2 * np.abs(plane[:2]).sum()
        return (float(part[row, col]) if offset[2] < 0 and above else 0.0), offset

    def _ahead(self, at: Floats, plane: Floats, lift_m: float) -> float:
        reach = (at[2] + self.ball[3] / (1 - self.inverse_m * self.ball[3])) * self.tangent
        if reach <= 0 or np.hypot(*at[:2]) > (self.half_m or self.ball[3]) + reach:
            return 0.0
        weights, sums = 0.0, 0.0
        for ring in range(SEARCH_RINGS):
            radius = reach / 2**ring
            level = self._level(0.7 * radius)
            both = [self.search, -self.search] if lift_m > 0 else [self.search]
            for place in np.concatenate(both) * (-0.75 if ring % 2 else 0.75) * radius:
                covered, offset = self._covered(at, plane, lift_m, level, place)
                if np.hypot(*offset[:2]) <= 0.71 * self._texel_m(level) - offset[2] * self.tangent:
                    weights, sums = weights + covered, sums - covered * offset[2]
        return sums / weights if weights > 0 else 0.0


def mixed_ratio(ratio: Floats, rest: Floats, without: Floats, lit: Floats, least: Floats) -> Floats:
    """R' / R of the rest and the discs together."""
    before = np.maximum(rest, least)
    return np.maximum(ratio * before + lit, least) / (before + without)


def irradiance(
    points: Floats,
    normal: Floats,
    toward: Floats,
    half_angle_rad: float,
    is_free: Callable[[Floats, Floats], Bools],
    parts: int = 1500,
) -> Floats:
    """[n] over pi, of a disc of irradiance 1 that things hide: `is_free` of origins [m, 3] and directions [m, 3]."""
    side = np.cross(toward, np.eye(3)[np.abs(toward).argmin()])
    side /= np.linalg.norm(side)
    index = np.arange(parts)
    radius, turn = np.tan(half_angle_rad) * np.sqrt((index + 0.5) / parts), np.pi * (3 - 5**0.5) * index
    across = np.cos(turn)[:, None] * side + np.sin(turn)[:, None] * np.cross(toward, side)
    directions = toward + radius[:, None] * across
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    cosines = np.maximum(directions @ normal, 0)
    free = np.stack([is_free(np.broadcast_to(p, directions.shape), directions) for p in points])
    return np.asarray((free * cosines).mean(axis=1))


def near_irradiance(
    points: Floats, normal: Floats, light: DirectLight, middle: Floats, met_m: Callable[[Floats, Floats], Floats]
) -> Floats:
    """[n] over pi and over the irradiance at `middle`, of a near disc, whose plane faces `middle`, that things hide:
    `met_m` of origins and directions [m, 3] is how far off they are met."""
    assert light.center_m is not None
    seen = light.seen_from(middle)
    side = np.cross(seen.direction, np.eye(3)[np.abs(seen.direction).argmin()])
    side /= np.linalg.norm(side)
    index, parts = np.arange(1500), 1500
    radius = seen.distance_m * np.tan(seen.half_angle_rad) * np.sqrt((index + 0.5) / parts)
    turn = np.pi * (3 - 5**0.5) * index
    across = np.cos(turn)[:, None] * side + np.sin(turn)[:, None] * np.cross(seen.direction, side)
    lamp, found = light.center_m + radius[:, None] * across, []
    for point in points:
        offset = lamp - point
        distance = np.linalg.norm(offset, axis=1)
        directions = offset / distance[:, None]
        is_free = met_m(np.broadcast_to(point, directions.shape), directions) > distance
        nearer = seen.distance_m / np.linalg.norm(light.center_m - point)
        found.append(nearer**2 * (is_free * np.maximum(directions @ normal, 0)).mean())
    return np.array(found)
