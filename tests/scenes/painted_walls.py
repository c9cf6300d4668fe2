"""Volumes whose voxels have known colours, among them a floor beside a wall."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from server.opencl.engine import Engine
from server.volume.volume import BRICK, Volume
from tests.scenes.analytic import Floats
from tests.scenes.solids import (
    Scene,
    box,
    fill_volume,
    floor,
)
from tests.scenes.volumes import in_bricks

VOXEL_M = 0.01
Bools = NDArray[np.bool_]
WALL, FLOOR = (0.6, 0.3, 0.1), (0.05, 0.1, 0.4)
MOST = np.array([511, 511, 255])


def paint(
    engine: Engine, volume: Volume, colors: Floats, has_color: Bools | bool = True, is_outdated: Bools | bool = False
) -> None:
    """Give every voxel [z, y, x] its linear RGB [..., 3] or none, packed as bricks.py has it; some of another light."""
    r, g, b = np.moveaxis(np.rint(np.sqrt(colors) * MOST).astype(np.uint32), -1, 0)
    weight = np.where(is_outdated, 1, 5)
    packed = np.where(has_color, r << 23 | g << 14 | b << 6 | weight, 0).astype(np.uint32)
    pool = engine.download(volume.colors)
    pool[engine.download(volume.slots_device).ravel()] = in_bricks(packed)
    volume.colors.set(pool, engine.queue)


def voxels_of(volume: Volume) -> tuple[int, ...]:
    return tuple(BRICK * n for n in volume.bricks[::-1])


def floor_beside_a_wall(engine: Engine, top_m: float = 1.0) -> tuple[Volume, Scene]:
    """A volume with a wall of one colour, as high as `top_m`, behind a floor of another."""
    scene: Scene = (floor(), box((-1.0, 0.0, -1.0), (2.0, top_m, 0.2)))
    volume = fill_volume(engine, scene, VOXEL_M)
    z, y, _ = np.indices(voxels_of(volume))
    is_wall = (z * VOXEL_M < 0.2) & (y * VOXEL_M > 0.1)
    paint(engine, volume, np.where(is_wall[..., None], WALL, FLOOR))
    return volume, scene


def wall_seen_from(distance_m: float, along_m: float, height_m: float) -> float:
    """Share of the cosine-weighted sky that a wall covers, for floor before the middle of it (form factor of a
    rectangle from a point in the plane through its lower edge, perpendicular to it)."""
    slant = np.hypot(distance_m, height_m)
    half = along_m / 2
    return float((np.arctan(half / distance_m) - distance_m / slant * np.arctan(half / slant)) / np.pi)
