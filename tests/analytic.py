"""Scenes whose every distance and every ray is known in closed form, and volumes filled from them.

Lengths are metres, points volume space. A scene is the union of its solids.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np
import pyopencl.cltypes as cl_types
from numpy.typing import ArrayLike, NDArray

from server.opencl.engine import Engine
from server.stages.raycast import LABEL_NONE, LABEL_STATIC, Surface
from server.stages.volume import BRICK, BRICK_VOXELS, Volume

Floats = NDArray[np.float64]


class Solid(Protocol):
    """A closed body."""

    def distance(self, points: Floats) -> Floats:
        """[n] signed distance of points [n, 3], negative inside; exact outside."""
        ...

    def hit(self, origins: Floats, directions: Floats) -> Floats:
        """[n] distance along unit rays to the body, 0 from inside, infinite where they pass."""
        ...

    def grown(self, by_m: float) -> Solid:
        """The body with its surface moved out by `by_m` (in where negative), or a little more at corners."""
        ...


@dataclass(frozen=True)
class HalfSpace:
    """Everything behind the plane through `point` with unit `normal`."""

    point: Floats
    normal: Floats

    def distance(self, points: Floats) -> Floats:
        return (points - self.point) @ self.normal

    def hit(self, origins: Floats, directions: Floats) -> Floats:
        height, fall = self.distance(origins), directions @ self.normal
        with np.errstate(divide="ignore", invalid="ignore"):
            t = np.where(fall < 0, -height / fall, np.inf)
        return np.where(height <= 0, 0.0, t)

    def grown(self, by_m: float) -> HalfSpace:
        return replace(self, point=self.point + by_m * self.normal)


@dataclass(frozen=True)
class Ball:
    """A sphere."""

    center: Floats
    radius: float

    def distance(self, points: Floats) -> Floats:
        return np.linalg.norm(points - self.center, axis=-1) - self.radius

    def hit(self, origins: Floats, directions: Floats) -> Floats:
        away = origins - self.center
        b = (away * directions).sum(-1)
        c = (away**2).sum(-1) - self.radius**2
        root = np.sqrt(np.maximum(b * b - c, 0.0))
        passes = (b * b < c) | (b > 0)
        return np.where(c <= 0, 0.0, np.where(passes, np.inf, -b - root))

    def grown(self, by_m: float) -> Ball:
        return replace(self, radius=self.radius + by_m)


@dataclass(frozen=True)
class Box:
    """A box along the axes."""

    low: Floats
    high: Floats

    def distance(self, points: Floats) -> Floats:
        beyond = np.maximum(self.low - points, points - self.high)
        return np.linalg.norm(np.maximum(beyond, 0), axis=-1) + np.minimum(beyond.max(-1), 0)

    def hit(self, origins: Floats, directions: Floats) -> Floats:
        slope = np.where(np.abs(directions) < 1e-12, 1e-12, directions)
        a, b = (self.low - origins) / slope, (self.high - origins) / slope
        enter, leave = np.minimum(a, b).max(-1), np.maximum(a, b).min(-1)
        return np.where((enter <= leave) & (leave >= 0), np.maximum(enter, 0.0), np.inf)

    def grown(self, by_m: float) -> Box:
        return Box(self.low - by_m, self.high + by_m)


Scene = Sequence[Solid]


def distance(scene: Scene, points: Floats) -> Floats:
    """[n] distance to the nearest solid."""
    return np.min([solid.distance(points) for solid in scene], axis=0)


def blocked(scene: Scene, origins: Floats, directions: Floats, reach_m: float, grown_m: float = 0.0) -> NDArray[np.bool_]:
    """[n] whether unit rays meet the scene, its surfaces moved out by `grown_m`, within `reach_m`."""
    return np.min([solid.grown(grown_m).hit(origins, directions) for solid in scene], axis=0) < reach_m


def floor(y: float = 0.1) -> HalfSpace:
    """Everything below a height; y is up."""
    return HalfSpace(np.array([0.0, y, 0.0]), np.array([0.0, 1.0, 0.0]))


def box(low: ArrayLike, high: ArrayLike) -> Box:
    """A box by its corners."""
    return Box(np.array(low, float), np.array(high, float))


def ball(center: ArrayLike, radius: float) -> Ball:
    """A ball by its centre."""
    return Ball(np.array(center, float), radius)


SIDE_M = 0.96
"""Side of the scenes below, from the origin."""

SCENES: dict[str, Scene] = {
    "ball above a floor": (floor(), ball((0.5, 0.42, 0.45), 0.2)),
    "room open at the top": (
        floor(),
        box((0.0, 0.0, 0.0), (0.1, 0.7, 0.96)),
        box((0.86, 0.0, 0.0), (0.96, 0.7, 0.96)),
        box((0.0, 0.0, 0.0), (0.96, 0.7, 0.1)),
        box((0.0, 0.0, 0.86), (0.96, 0.7, 0.96)),
    ),
    "floor under a wall": (floor(), box((-1.0, 0.0, 0.0), (2.0, 0.96, 0.2))),
    "narrow slit": (floor(), box((0.0, 0.5, 0.0), (0.96, 0.58, 0.46)), box((0.0, 0.5, 0.52), (0.96, 0.58, 0.96))),
}


def fill_volume(engine: Engine, scene: Scene, voxel_m: float, size_m: ArrayLike = (SIDE_M,) * 3) -> Volume:
    """A volume whose voxels hold the scene's exact distance, as if every surface had been seen from everywhere.

    Voxels deeper than the truncation are unseen, as after integration.
    """
    volume = Volume(engine, (0.0, 0.0, 0.0, *(float(s) for s in np.asarray(size_m, float))), voxel_m)
    bricks = np.stack(np.meshgrid(*(np.arange(n) for n in volume.bricks[::-1]), indexing="ij"), -1).reshape(-1, 3)
    bricks = bricks[:, ::-1]  # table order: x fastest
    reach_m = volume.truncation_m + BRICK * voxel_m
    near = np.abs(distance(scene, (bricks + 0.5) * BRICK * voxel_m)) < reach_m
    near &= np.arange(len(near)) >= 0
    held = np.flatnonzero(near).astype(np.int32)
    assert len(held) <= volume.capacity
    volume._slots.ravel()[held] = np.arange(len(held))
    volume._allocated = held
    cells = np.stack(np.meshgrid(*(np.arange(BRICK),) * 3, indexing="ij"), -1).reshape(-1, 3)[:, ::-1]
    centers = ((bricks[held] * BRICK)[:, None] + cells + 0.5) * voxel_m
    signed_m = distance(scene, centers.reshape(-1, 3)).reshape(len(held), BRICK_VOXELS)
    voxels = np.zeros((volume.capacity, BRICK_VOXELS, 2), np.float32)
    voxels[: len(held), :, 0] = np.clip(signed_m / volume.truncation_m, -1, 1)
    voxels[: len(held), :, 1] = signed_m > -volume.truncation_m
    volume.voxels.set(voxels.view(cl_types.float2)[..., 0])
    volume._upload_table()
    volume.summarize()
    return volume


def solid_voxels(scene: Scene, volume: Volume) -> NDArray[np.bool_]:
    """[x, y, z] voxels that `fill_volume` makes solid: seen and behind a surface."""
    index = np.stack(np.meshgrid(*(np.arange(BRICK * n) for n in volume.bricks), indexing="ij"), -1)
    signed_m = distance(scene, ((index + 0.5) * volume.voxel_m).reshape(-1, 3)).reshape(index.shape[:-1])
    return (signed_m < 0) & (signed_m > -volume.truncation_m)


def float4(xyz: Floats, w: Floats | float = 1.0) -> NDArray[np.float32]:
    """[..., 3] and [...] -> [...] float4, ready for upload."""
    packed = np.zeros((*xyz.shape[:-1], 4), np.float32)
    packed[..., :3], packed[..., 3] = xyz, w
    return packed.view(cl_types.float4)[..., 0]


def unpack4(engine: Engine, array: object) -> NDArray[np.float32]:
    """[...] float4 on the device -> [..., 4]."""
    host = engine.download(array)  # type: ignore[arg-type]
    return host.view(np.float32).reshape(*host.shape, 4)


def upload_surface(engine: Engine, positions: Floats, normals: Floats, valid: NDArray[np.bool_]) -> Surface:
    """A geometry buffer [h, w] of given points (volume space) and unit normals."""
    space = engine.workspace
    return Surface(
        space.upload("positions", float4(np.where(valid[..., None], positions, 0), valid)),
        space.upload("normals", float4(np.where(valid[..., None], normals, 0), valid)),
        space.upload("labels", np.where(valid, LABEL_STATIC, LABEL_NONE).astype(np.uint8)),
    )


def points_on(scene: Scene, count: int, seed: int, within: tuple[ArrayLike, ArrayLike]) -> tuple[Floats, Floats]:
    """`count` random points on the scene's surfaces inside a box, and their normals: where random rays meet them."""
    random = np.random.default_rng(seed)
    low, high = (np.asarray(corner, float) for corner in within)
    found: list[Floats] = []
    while sum(map(len, found)) < count:
        origins = random.uniform(low, high, (4 * count, 3))
        origins = origins[distance(scene, origins) > 0]
        directions = random.normal(size=origins.shape)
        directions /= np.linalg.norm(directions, axis=-1, keepdims=True)
        t = np.min([solid.hit(origins, directions) for solid in scene], axis=0)
        hits = origins[np.isfinite(t)] + t[np.isfinite(t), None] * directions[np.isfinite(t)]
        found.append(hits[((hits > low) & (hits < high)).all(-1)])
    points = np.concatenate(found)[:count]
    return points, _gradient(scene, points)


def _gradient(scene: Scene, points: Floats) -> Floats:
    step = 1e-6 * np.eye(3)
    normals = np.stack([distance(scene, points + s) - distance(scene, points - s) for s in step], -1)
    return normals / np.linalg.norm(normals, axis=-1, keepdims=True)
