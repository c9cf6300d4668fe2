"""Closed bodies whose every distance and every ray's hit is known in closed form, and volumes filled from them.

Lengths are metres, points volume space (y is up here). A scene is the union of its solids.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any, Protocol

import numpy as np
import pyopencl.array as cl_array
import pyopencl.cltypes as cl_types
from numpy.typing import ArrayLike, NDArray

from server.opencl.engine import Engine
from server.volume.raycast import LABEL_NONE, LABEL_STATIC, Surface
from server.volume.volume import BRICK, Volume
from tests.scenes.analytic import Floats
from tests.scenes.volumes import fill, vectors


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


@dataclass(frozen=True, eq=False)
class HalfSpace:
    """Everything behind the plane through `point` with unit `normal`."""

    point: Floats
    normal: Floats

    def distance(self, points: Floats) -> Floats:
        return (points - self.point) @ self.normal

    def hit(self, origins: Floats, directions: Floats) -> Floats:
        height, fall = self.distance(origins), directions @ self.normal
        t = -height / np.minimum(fall, -1e-300)
        return np.where(height <= 0, 0.0, np.where(fall < 0, t, np.inf))

    def grown(self, by_m: float) -> HalfSpace:
        return replace(self, point=self.point + by_m * self.normal)


@dataclass(frozen=True, eq=False)
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
        passes = (b * b < c) | (b > 0)
        return np.where(c <= 0, 0.0, np.where(passes, np.inf, -b - np.sqrt(np.maximum(b * b - c, 0.0))))

    def grown(self, by_m: float) -> Ball:
        return replace(self, radius=self.radius + by_m)


@dataclass(frozen=True, eq=False)
class Box:
    """A box along the axes."""

    low: Floats
    high: Floats

    def distance(self, points: Floats) -> Floats:
        x, y, z = np.maximum(self.low - points, points - self.high).T  # by column: along rows of 3 NumPy is slow
        outside = np.sqrt(np.maximum(x, 0) ** 2 + np.maximum(y, 0) ** 2 + np.maximum(z, 0) ** 2)
        return outside + np.minimum(np.maximum(np.maximum(x, y), z), 0)

    def hit(self, origins: Floats, directions: Floats) -> Floats:
        slope = np.where(np.abs(directions) < 1e-12, 1e-12, directions)
        a, b = ((self.low - origins) / slope).T, ((self.high - origins) / slope).T
        enter, leave = np.minimum(a, b).max(0), np.maximum(a, b).min(0)
        return np.where((enter <= leave) & (leave >= 0), np.maximum(enter, 0.0), np.inf)

    def grown(self, by_m: float) -> Box:
        return Box(self.low - by_m, self.high + by_m)


Scene = Sequence[Solid]


def floor(y: float = 0.1) -> HalfSpace:
    """Everything below a height."""
    return HalfSpace(np.array([0.0, y, 0.0]), np.array([0.0, 1.0, 0.0]))


def box(low: ArrayLike, high: ArrayLike) -> Box:
    """A box by its corners."""
    return Box(np.array(low, float), np.array(high, float))


def ball(center: ArrayLike, radius: float) -> Ball:
    """A ball by its centre."""
    return Ball(np.array(center, float), radius)


SIDE_M = 0.96
"""Side of the volume of the scenes below."""

INSIDE = ((0.11, 0.05, 0.11), (0.85, 0.9, 0.85))
"""A box that holds surface of each of them and stays clear of the volume's border."""

SCENES: dict[str, Scene] = {
    "ball above a floor": (floor(), ball((0.5, 0.42, 0.45), 0.2)),
    "room open at the top": (
        floor(),
        box((-1.0, 0.0, -1.0), (0.1, 0.7, 2.0)),
        box((0.86, 0.0, -1.0), (2.0, 0.7, 2.0)),
        box((-1.0, 0.0, -1.0), (2.0, 0.7, 0.1)),
        box((-1.0, 0.0, 0.86), (2.0, 0.7, 2.0)),
    ),
    "floor under a wall": (floor(), box((-1.0, 0.0, -1.0), (2.0, 2.0, 0.2))),
    "narrow slit": (floor(), box((-1, 0.5, -1), (2, 0.58, 0.46)), box((-1, 0.5, 0.52), (2, 0.58, 2))),
}


def distance(scene: Scene, points: Floats) -> Floats:
    """[n] distance to the nearest solid."""
    return np.min([solid.distance(points) for solid in scene], axis=0)


def hit(scene: Scene, origins: Floats, directions: Floats, grown_m: float = 0.0) -> Floats:
    """[n] how far unit rays go before they meet the scene, its surfaces moved out by `grown_m`."""
    return np.min([solid.grown(grown_m).hit(origins, directions) for solid in scene], axis=0)


def normal_at(scene: Scene, points: Floats) -> Floats:
    """[n, 3] unit normals of points on the scene's surfaces."""
    step = 1e-6 * np.eye(3)
    normals = np.stack([distance(scene, points + s) - distance(scene, points - s) for s in step], -1)
    return normals / np.linalg.norm(normals, axis=-1, keepdims=True)


def points_on(
    scene: Scene, count: int, seed: int, within: tuple[ArrayLike, ArrayLike] = INSIDE
) -> tuple[Floats, Floats]:
    """`count` random points on the scene's surfaces inside a box, and their normals: where random rays meet them."""
    random = np.random.default_rng(seed)
    low, high = (np.asarray(corner, float) for corner in within)
    points = np.empty((0, 3))
    while len(points) < count:
        origins = random.uniform(low, high, (4 * count, 3))
        origins = origins[distance(scene, origins) > 0]
        directions = random.normal(size=origins.shape)
        directions /= np.linalg.norm(directions, axis=-1, keepdims=True)
        t = hit(scene, origins, directions)
        hits = (origins + np.where(np.isfinite(t), t, 0)[:, None] * directions)[np.isfinite(t)]
        points = np.concatenate([points, hits[((hits > low) & (hits < high)).all(-1)]])
    return points[:count], normal_at(scene, points[:count])


def signed_distances(scene: Scene, volume: Volume) -> Floats:
    """[z, y, x] metres, at the centres of all voxels; not to be written to."""
    return _signed_distances(tuple(scene), tuple(volume.bricks), volume.voxel_m)


@lru_cache(maxsize=6)
def _signed_distances(scene: tuple[Solid, ...], bricks: tuple[int, ...], voxel_m: float) -> Floats:
    """Kept: many tests fill a volume from the same scene, and then ask which of its voxels are solid."""
    x, y, z = ((np.arange(BRICK * count) + 0.5) * voxel_m for count in bricks)
    centers = np.stack(np.meshgrid(z, y, x, indexing="ij")[::-1], -1)
    found = distance(scene, centers.reshape(-1, 3)).reshape(centers.shape[:3])
    found.setflags(write=False)
    return found


def fill_volume(engine: Engine, scene: Scene, voxel_m: float, side_m: float = SIDE_M) -> Volume:
    """A cubic volume whose voxels hold the scene's exact distance, as if all surfaces had been seen from everywhere.

    Voxels deeper than the truncation are unseen, as after integration.
    """
    volume = Volume(engine, (0.0, 0.0, 0.0, side_m, side_m, side_m), voxel_m)
    signed_m = signed_distances(scene, volume)
    fill(engine, volume, np.clip(signed_m / volume.truncation_m, -1, 1), signed_m > -volume.truncation_m)
    return volume


def solid_voxels(scene: Scene, volume: Volume) -> NDArray[np.bool_]:
    """[z, y, x] the voxels that `fill_volume` makes solid: seen, and behind a surface."""
    signed_m = signed_distances(scene, volume)
    return (signed_m < 0) & (signed_m > -volume.truncation_m)


def scattered(
    engine: Engine, share: float, voxel_m: float, random: np.random.Generator
) -> tuple[Volume, NDArray[np.bool_]]:
    """A volume in which a share of the voxels is solid, each alone and at random: [z, y, x] which."""
    volume = Volume(engine, (0.0, 0.0, 0.0, SIDE_M, SIDE_M, SIDE_M), voxel_m)
    solid = random.random([BRICK * n for n in volume.bricks[::-1]]) < share
    fill(engine, volume, np.where(solid, -0.5, 1.0), np.ones(solid.shape))
    return volume, solid


def float4(xyz: NDArray[Any], w: NDArray[Any] | float = 1.0) -> NDArray[np.void]:
    """[..., 3] and [...] -> [...] float4, ready for upload."""
    packed = np.zeros((*xyz.shape[:-1], 4), np.float32)
    packed[..., :3], packed[..., 3] = xyz, w
    return packed.view(cl_types.float4)[..., 0]


def download4(engine: Engine, array: cl_array.Array) -> NDArray[np.float32]:
    """[...] float4 on the device -> [..., 4]."""
    return vectors(engine.download(array))


def upload_surface(engine: Engine, positions: Floats, normals: Floats, valid: NDArray[np.bool_]) -> Surface:
    """A geometry buffer [h, w] of given points (volume space) and unit normals."""
    space = engine.workspace
    return Surface(
        space.upload("positions", float4(np.where(valid[..., None], positions, 0), valid)),
        space.upload("normals", float4(np.where(valid[..., None], normals, 0), valid)),
        space.upload("labels", np.where(valid, LABEL_STATIC, LABEL_NONE).astype(np.uint8)),
    )
