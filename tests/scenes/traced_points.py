"""Radiance transfer of given surface points."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from protocol.frames import CameraModel
from server.opencl.engine import Engine
from server.transfer.radiance_transfer import direction_sets, transfer_radiance
from server.volume.volume import Volume
from tests.scenes.analytic import Floats
from tests.scenes.solids import (
    upload_surface,
)

VOXEL_M = 0.01
ROOM_M = 1000.0
STRIDE = 4


@dataclass(frozen=True)
class Traced:
    """A result on the host, and the geometry buffer [h, w, 4] it was asked for: a block of STRIDE^2 pixels a sample."""

    transfer: Floats
    openness: Floats
    flatness: Floats
    free: NDArray[np.bool_]
    positions: Floats
    normals: Floats

    @property
    def origins(self) -> Floats:
        """[rows, cols, 3] where rays begin: a voxel off the surface."""
        pixels = np.s_[STRIDE // 2 :: STRIDE, STRIDE // 2 :: STRIDE, :3]
        return self.positions[pixels] + VOXEL_M * self.normals[pixels]


def camera_of(width: int, height: int) -> CameraModel:
    return CameraModel(width=width, height=height, fx=100.0, fy=100.0, cx=0.0, cy=0.0)


def transfer_of(
    engine: Engine,
    volume: Volume,
    positions: Floats,
    normals: Floats,
    stride: int,
    *,
    rays: int = 81,
    bands: int = 4,
    ray_length_m: float = ROOM_M,
) -> Traced:
    """Transfer of a geometry buffer [h, w, 4]."""
    surface = upload_surface(engine, positions[..., :3], normals[..., :3], positions[..., 3] > 0)
    camera = camera_of(positions.shape[1], positions.shape[0])
    result = transfer_radiance(engine, camera, volume, surface, stride, direction_sets(rays, bands), ray_length_m)
    bits = np.unpackbits(engine.download(result.free_mask).view(np.uint8), axis=-1, bitorder="little")
    found = (engine.download(a) for a in (result.coefficients, result.openness, result.flatness))
    return Traced(*found, bits[..., :rays].astype(bool), positions, normals)


def trace(
    engine: Engine,
    volume: Volume,
    points: Floats,
    normals: Floats,
    *,
    rays: int = 81,
    bands: int = 4,
    ray_length_m: float = ROOM_M,
) -> Traced:
    """Transfer of given points, 8 in a row; each fills a block of pixels, so that no neighbour is mixed in."""
    blocks = [
        np.repeat(np.repeat(np.insert(a.reshape(-1, 8, 3), 3, 1, -1), STRIDE, 0), STRIDE, 1) for a in (points, normals)
    ]
    positions, normals = (block.astype(np.float32).astype(np.float64) for block in blocks)
    return transfer_of(engine, volume, positions, normals, STRIDE, rays=rays, bands=bands, ray_length_m=ray_length_m)
