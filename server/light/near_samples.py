"""Samples for the search of lights inside the room (B4): means over 4 x 4 samples of one surface each, on the host.

Between them the 16 trace an even lattice of directions, so that their view of the sky has little quadrature error.
Kernel: near_light.cl.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import numpy as np
import pyopencl.array as cl_array
import pyopencl.cltypes as cl_types
from numpy.typing import NDArray

from protocol.frames import CameraModel
from server.light.light_estimation import LEAST_FLATNESS, LEAST_OPENNESS
from server.maths.sh import spherical_fibonacci
from server.opencl.engine import Engine
from server.quality.settings import WHOLE_ROOM_M
from server.transfer.radiance_transfer import (
    SETS_A_FRAME,
    Directions,
    Transfer,
    direction_sets,
    own_sets,
    room_for_transfer,
    transfer_radiance,
    window_arguments,
)
from server.volume.raycast import Surface
from server.volume.volume import Volume

LOBES = 96
"""Number of lobes that represent the distant light, from which a lamp must be distinguished: enough to represent any
band-limited sky well."""
LEAST_SHARE = 0.5
"""Least share of usable samples in a pool: fewer have too few directions together."""
_POOL = 4
_SPARE = 1.25  # pools that are traced for one that is asked for: some turn out to see too little of the sky
_RAYS, _BANDS = 81, 4
_SPACING = 1 / 160
"""Spacing of samples in picture widths. Pools of twice the size blur the light of a lamp half a metre away: it is found
12 cm from its place instead of 4 cm."""
_LOBE_SHARPNESS = 20.0  # half of the peak at 15 degrees; neighbours are 21 degrees apart


@dataclass(frozen=True)
class PooledSamples:
    """Means over 4 x 4 samples of one surface each, on the host, float64."""

    positions: NDArray[np.float64]
    """[n, 3] volume space, metres."""
    normals: NDArray[np.float64]
    """[n, 3] unit, world axes."""
    colors: NDArray[np.float64]
    """[n, 3] linear RGB."""
    sky: NDArray[np.float64]
    """[n, LOBES] what a white surface would show of each lobe of the sky."""

    def __len__(self) -> int:
        return len(self.positions)

    def taken(self, which: NDArray[np.bool_] | NDArray[np.int64]) -> PooledSamples:
        """Those of them that a mask or a list of numbers names."""
        return PooledSamples(self.positions[which], self.normals[which], self.colors[which], self.sky[which])

    def thinned(self, count: int, random: np.random.Generator) -> PooledSamples:
        """At most `count` of them."""
        return self.taken(np.sort(random.permutation(len(self))[:count]))

    def __add__(self, other: PooledSamples) -> PooledSamples:
        return PooledSamples(
            np.concatenate([self.positions, other.positions]),
            np.concatenate([self.normals, other.normals]),
            np.concatenate([self.colors, other.colors]),
            np.concatenate([self.sky, other.sky]),
        )


@cache
def lobe_directions() -> NDArray[np.float64]:
    """[LOBES, 3] unit, world: where the lobes are brightest."""
    return spherical_fibonacci(LOBES)


def lobe_radiance(directions: NDArray[np.float64]) -> NDArray[np.float64]:
    """[..., LOBES] radiance of each lobe along unit `directions` [..., 3]; together they are about 1 everywhere."""
    values = np.exp(_LOBE_SHARPNESS * (directions @ lobe_directions().T - 1))
    mean = (1 - np.exp(-2 * _LOBE_SHARPNESS)) / (2 * _LOBE_SHARPNESS)
    return np.asarray(values / (LOBES * mean))


@cache
def _lobe_table(count: int, bands: int) -> NDArray[np.float32]:
    """[SETS_A_FRAME, count, LOBES] of the sets that pooled frames take."""
    return lobe_radiance(direction_sets(count, bands).directions[:SETS_A_FRAME, :, :3].astype(np.float64)).astype(
        np.float32
    )


def pool_samples(
    engine: Engine,
    camera: CameraModel,
    radiance: cl_array.Array,
    surface: Surface,
    transfer: Transfer,
    rays: Directions,
    voxel_m: float,
) -> PooledSamples:
    """Usable samples of a frame (as `sum_tiles` has it), pooled. radiance: [h, w] float4 as in Measurement.

    `transfer` is of the first turn's direction sets, none of its visibility from other frames.
    """
    rows, cols = transfer.rows // _POOL, transfer.cols // _POOL
    space = engine.workspace
    positions, normals, colors = (
        space.array(f"near_{name}", (rows, cols), cl_types.float4) for name in ("positions", "normals", "colors")
    )
    sky = space.array("near_sky", (rows, cols, LOBES), np.float32)
    engine.launch(
        engine.kernel("near_light.cl", "pool_sky", LOBES=LOBES, LANES=engine.lanes),
        (cols, rows),
        cols,
        rows,
        transfer.cols,
        transfer.stride,
        camera.width,
        camera.height,
        surface.positions,
        surface.normals,
        surface.labels,
        radiance,
        transfer.openness,
        transfer.flatness,
        LEAST_OPENNESS,
        LEAST_FLATNESS,
        voxel_m,
        rays.count,
        transfer.free_mask.shape[2],
        rays.on_device(engine),
        space.constant("near_lobes", _lobe_table(rays.count, transfer.bands)),
        transfer.free_mask,
        positions,
        normals,
        colors,
        sky,
    )
    place = _vectors(engine, positions)
    found = PooledSamples(
        place[:, :3],
        _vectors(engine, normals)[:, :3],
        _vectors(engine, colors)[:, :3],
        engine.download(sky).reshape(-1, LOBES).astype(np.float64),
    )
    return found.taken(place[:, 3] >= LEAST_SHARE)


def see_samples(
    engine: Engine, camera: CameraModel, radiance: cl_array.Array, surface: Surface, volume: Volume
) -> PooledSamples:
    """Pooled samples of a frame with rays of their own, whatever the session's are: whole, and as long as the room."""
    rays = direction_sets(_RAYS, _BANDS)
    transfer = transfer_radiance(engine, camera, volume, surface, _stride(camera), rays, WHOLE_ROOM_M)
    return pool_samples(engine, camera, radiance, surface, transfer, rays, volume.voxel_m)


def see_some(
    engine: Engine,
    camera: CameraModel,
    radiance: cl_array.Array,
    surface: Surface,
    volume: Volume,
    most: int,
    random: np.random.Generator,
) -> PooledSamples:
    """At most `most` of `see_samples`, picked at random; of the others no ray is traced."""
    usable = _usable(engine, camera, radiance, surface, volume.voxel_m)
    rows, cols = (size // _POOL for size in usable.shape)
    members = usable[: rows * _POOL, : cols * _POOL].reshape(rows, _POOL, cols, _POOL)
    pools = np.flatnonzero(members.sum(axis=(1, 3)) >= LEAST_SHARE * _POOL**2)
    picked = np.zeros((rows, cols), np.bool_)
    picked.flat[random.permutation(pools)[: round(_SPARE * most)]] = True
    wanted = np.zeros_like(usable)
    wanted[: rows * _POOL, : cols * _POOL] = (members & picked[:, None, :, None]).reshape(rows * _POOL, cols * _POOL)
    chosen = np.flatnonzero(wanted).astype(np.int32)
    rays = direction_sets(_RAYS, _BANDS)
    transfer = transfer_radiance(engine, camera, volume, surface, _stride(camera), rays, WHOLE_ROOM_M, chosen=chosen)
    return pool_samples(engine, camera, radiance, surface, transfer, rays, volume.voxel_m).thinned(most, random)


def _stride(camera: CameraModel) -> int:
    return max(1, round(camera.width * _SPACING))


def _usable(
    engine: Engine, camera: CameraModel, radiance: cl_array.Array, surface: Surface, voxel_m: float
) -> NDArray[np.bool_]:
    """[rows, cols] samples that can be pooled if they see enough of the sky; they see none yet."""
    stride = _stride(camera)
    rows, cols = camera.height // stride, camera.width // stride
    rays, space = direction_sets(_RAYS, _BANDS), engine.workspace
    room = room_for_transfer(engine, rows, cols, stride, rays, own_sets(engine, rows, cols))
    usable = space.array("near_usable", (rows, cols), np.uint8)
    engine.launch(
        engine.kernel("near_light.cl", "find_samples", LOBES=LOBES, LANES=engine.lanes),
        (cols, rows),
        *window_arguments(camera, surface, stride),
        surface.labels,
        radiance,
        LEAST_FLATNESS,
        voxel_m,
        room.openness,
        usable,
    )
    return np.asarray(engine.download(usable) != 0)


def _vectors(engine: Engine, array: cl_array.Array) -> NDArray[np.float64]:
    """[items, 4] of an array of float4."""
    return engine.download(array).view(np.float32).reshape(-1, 4).astype(np.float64)
