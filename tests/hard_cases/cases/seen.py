"""Pictures of surface of any direction under a known light, as the device's sums want them."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from server.light.light_estimation import ASSUMED_ALBEDO, LightEstimate, TileSums, sum_tiles
from server.opencl.engine import Engine
from server.volume.raycast import LABEL_STATIC
from tests.reference.sh import open_transfer
from tests.scenes import lights
from tests.scenes.light_samples import Frame

Floats = NDArray[np.float64]

ROWS, COLS, STRIDE = 48, 64, 4
COUNT = ROWS * COLS
VOXEL_M = 0.01
LIGHT = lights.lobe_and_sky((0.4, 0.7, -0.5))
SEEN = slice(0, 9)
"""Bands that an open surface shows."""
FLOAT = 2.0**-24
"""Greatest relative rounding of a float32."""


def around() -> Floats:
    """[COUNT, 3] evenly random."""
    return lights.random_directions(COUNT, 4)


def walls(*normals: ArrayLike) -> Floats:
    """[COUNT, 3] of which each of `normals` has as many, in columns beside one another."""
    chosen = np.arange(COUNT) % COLS * len(normals) // COLS
    return lights.unit(np.array(normals, float))[chosen]


def picture(
    normals: Floats, light: Floats, *, noise: float = 0.0, openness: float = 1.0, marks: Any = 1.0, seed: int = 0
) -> Frame:
    """Grey surface with `normals` [COUNT, 3]; each sample fills a block of pixels, so that no neighbour is mixed in.

    `marks` [COUNT]: 1 usable, 0 clipped or black, see Measurement.
    """
    bands = round(len(light) ** 0.5)
    transfer = openness * open_transfer(normals, bands)
    rgb = ASSUMED_ALBEDO * transfer @ light
    rgb += noise * np.random.default_rng(seed).normal(size=rgb.shape)
    blocks = np.column_stack([rgb, np.broadcast_to(marks, COUNT)]).reshape(ROWS, COLS, 4)
    row, col = np.indices((ROWS, COLS))
    positions = VOXEL_M * np.stack([col, row, np.zeros_like(row)], -1)
    radiance, facing, places = (
        np.repeat(np.repeat(a.astype(np.float32).astype(float), STRIDE, 0), STRIDE, 1)
        for a in (blocks, normals.reshape(ROWS, COLS, 3), positions)
    )
    return Frame(
        STRIDE,
        radiance,
        np.full(radiance.shape[:2], LABEL_STATIC, np.uint8),
        places,
        facing,
        transfer.reshape(ROWS, COLS, -1),
        np.full((ROWS, COLS), openness),
        np.ones((ROWS, COLS)),
    )


def sums(engine: Engine, normals: Floats, light: Floats = LIGHT, **more: Any) -> TileSums:
    """Of the device."""
    return sum_tiles(engine, *picture(normals, light, **more).upload(engine), VOXEL_M)


def shading(estimate: LightEstimate, normals: ArrayLike) -> Floats:
    """[..., 3] radiance of white surface with `normals` [..., 3] under the estimate."""
    return np.asarray(open_transfer(np.asarray(normals, float), round(len(estimate.sh) ** 0.5)) @ estimate.sh)
