"""Lights inside the room (B4): the search for lamps, and the radiance without their light.

The mathematics is in server/maths/near_light.py, the samples are those of near_samples.py. Kernels: near_light.cl.
"""

from __future__ import annotations

import numpy as np
import pyopencl as cl
import pyopencl.array as cl_array
import pyopencl.cltypes as cl_types
from numpy.typing import NDArray

from server.light.light_estimation import ASSUMED_ALBEDO
from server.light.near_samples import PooledSamples
from server.maths.emitters import Emitter, Scene
from server.maths.near_light import LEAST_MISFIT, LONG_STEP, STEP, Found, Steps, find_emitters
from server.opencl.engine import Engine
from server.volume.raycast import Surface
from server.volume.volume import BRICK, Volume

CLEARANCE_M = 0.08
"""Surface nearer to a lamp than this belongs to the lamp: its bulb and shade cast no shadow."""
_GRID_M = 0.25
_SURROUND_M, _PATCH_M, _PATCH_POINTS = 0.4, 0.8, 3


class Emitters:
    """The light that samples would receive from emitters anywhere in the volume."""

    def __init__(self, engine: Engine, volume: Volume, samples: PooledSamples, name: str = "near") -> None:
        """`name`: of the buffers for the samples. Two searches at the same time need different names."""
        self._engine = engine
        self._volume = volume
        self._count = len(samples)
        self._positions = _upload(engine, f"{name}_points", samples.positions)
        self._normals = _upload(engine, f"{name}_facing", samples.normals)

    @staticmethod
    def compiled(engine: Engine) -> cl.Kernel:
        """The kernel of `shares`."""
        return engine.kernel("near_light.cl", "see_emitters", LANES=engine.lanes)

    def shares(self, emitters: NDArray[np.float64]) -> NDArray[np.float32]:
        """[emitters, samples] g = V max(n.w, 0) / (pi d^2) of emitters [n, 3] in volume space, 1 / m^2."""
        engine = self._engine
        size = len(emitters) * self._count
        found = engine.workspace.array("near_shares", (-(-size // _SHARES_STEP) * _SHARES_STEP,), np.float32)
        engine.launch(
            self.compiled(engine),
            (-(-self._count // engine.lanes), len(emitters)),
            self._count,
            len(emitters),
            self._positions,
            self._normals,
            _upload(engine, "near_emitters", emitters),
            CLEARANCE_M,
            *self._volume.arguments(),
            found,
        )
        shares: NDArray[np.float32] = engine.download(found)[:size].reshape(len(emitters), self._count)
        return shares


_VECTORS_STEP, _SHARES_STEP = 2048, 1 << 20
"""Arrays grow in these steps, so that searches of similar size allocate no new memory."""


def _upload(engine: Engine, name: str, vectors: NDArray[np.float64]) -> cl_array.Array:
    padded = np.zeros((-(-len(vectors) // _VECTORS_STEP) * _VECTORS_STEP, 4), np.float32)
    padded[: len(vectors), :3] = vectors
    return engine.workspace.upload(name, padded.view(cl_types.float4)[:, 0])


def search_lamps(
    engine: Engine,
    volume: Volume,
    samples: PooledSamples,
    albedo: float = ASSUMED_ALBEDO,
    least_misfit: float = LEAST_MISFIT,
) -> Steps[Found]:
    """Lamps in the volume, in volume space, and the light from outside (`outside_light`) beside them.

    About a second of processor time, in pieces.
    """
    yield LONG_STEP
    emitters = Emitters(engine, volume, samples)
    outside = outside_light(volume, samples, emitters)
    scene = Scene(samples.positions, samples.normals, samples.colors / albedo, outside)
    yield STEP
    return (yield from find_emitters(scene, emitters.shares, _grid(_size_m(volume)), least_misfit=least_misfit))


def outside_light(volume: Volume, samples: PooledSamples, emitters: Emitters) -> NDArray[np.float64]:
    """[samples, LOBES + patches] what samples would show, were they white, of the sky's lobes and of the surround.

    The surround are shining patches beyond each face of the volume: a window that no camera has seen lights a room as
    such a patch does, not as a distant sky.
    """
    patches = surround_patches(_size_m(volume))
    seen = emitters.shares(patches.reshape(-1, 3)).reshape(len(patches), patches.shape[1], -1).mean(axis=1)
    return np.concatenate([samples.sky, seen.T.astype(np.float64)], axis=1)


def _size_m(volume: Volume) -> NDArray[np.float64]:
    return BRICK * volume.voxel_m * np.array(volume.bricks)


def _grid(size_m: NDArray[np.float64]) -> NDArray[np.float64]:
    """[n, 3] where a search begins, all over the volume."""
    axes = [np.arange(_GRID_M / 2, length, _GRID_M) for length in size_m]
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)


def surround_patches(size_m: NDArray[np.float64]) -> NDArray[np.float64]:
    """[patches, 9, 3] points of square patches of about 0.8 m on the box 0.4 m around the volume."""
    low, high = np.full(3, -_SURROUND_M), size_m + _SURROUND_M
    patches = []
    for axis in range(3):
        u, v = (other for other in range(3) if other != axis)
        counts = [max(1, round((high[other] - low[other]) / _PATCH_M)) for other in (u, v)]
        lines = [
            np.linspace(low[other], high[other], 2 * _PATCH_POINTS * count + 1)[1::2].reshape(count, _PATCH_POINTS)
            for other, count in zip((u, v), counts, strict=True)
        ]
        for side in (low[axis], high[axis]):
            for across in lines[0]:
                for along in lines[1]:
                    points = np.full((_PATCH_POINTS**2, 3), side)
                    points[:, u], points[:, v] = np.repeat(across, _PATCH_POINTS), np.tile(along, _PATCH_POINTS)
                    patches.append(points)
    return np.array(patches)


def remove_lamps(
    engine: Engine,
    radiance: cl_array.Array,
    surface: Surface,
    volume: Volume,
    lamps: tuple[Emitter, ...],
    albedo: float = ASSUMED_ALBEDO,
) -> cl_array.Array:
    """The picture [h, w] float4 less the lamps' light: what the distant light alone would show."""
    if not lamps:
        return radiance
    table = np.zeros((2 * len(lamps), 4), np.float32)
    table[::2, :3] = [lamp.position for lamp in lamps]
    table[1::2, :3] = [lamp.intensity for lamp in lamps]
    pixels = int(np.prod(radiance.shape))
    without = engine.workspace.array("without_lamps", radiance.shape, cl_types.float4)
    engine.launch(
        engine.kernel("near_light.cl", "remove_lamps", LANES=engine.lanes),
        (-(-pixels // engine.lanes),),
        pixels,
        len(lamps),
        surface.positions,
        surface.normals,
        engine.workspace.upload("lamps", table.view(cl_types.float4)[:, 0]),
        CLEARANCE_M,
        albedo,
        *volume.arguments(),
        radiance,
        without,
    )
    return without
