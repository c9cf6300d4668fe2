"""Surface prediction (KinectFusion; thesis 4.2.1): ray casts the volume from a camera. Kernel: raycast.cl."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pyopencl as cl
import pyopencl.array as cl_array
import pyopencl.cltypes as cl_types
from numpy.typing import NDArray

from protocol.frames import CameraModel
from server.input.measure import GREATEST_DEPTH_M, intrinsics
from server.maths.rigid import inverse_rigid
from server.opencl.buffers import BufferDescription, StageBuffers
from server.opencl.engine import Engine, float16, int4
from server.volume.volume import Volume

LABEL_NONE, LABEL_STATIC, LABEL_DYNAMIC, LABEL_FILLED = 0, 1, 2, 3

_TILE = 8  # as in raycast.cl
_SPACING = 2  # as in raycast.cl
_REST_ENTRY = 5  # ENTRY of raycast.cl
_REST_ITEMS = 256
"""Work-items that share these rays on a processor. PoCL's threads take 64 groups at a time: while only the first of 600
had work, one of two cores did most of it."""
_FARTHEST = int(np.float32(np.inf).view(np.int32))


class SurfaceBuffers(StageBuffers):
    """Device buffers of one surface. A caller that needs two surfaces at once declares a `BufferGroup` for each."""

    positions = BufferDescription(cl_types.float4)
    normals = BufferDescription(cl_types.float4)
    labels = BufferDescription(np.uint8)


class _RayBuffers(StageBuffers):
    nearest = BufferDescription(np.int32)
    """[tile row, tile column] depth at which rays begin, as bits of float metres."""
    farthest = BufferDescription(np.int32)
    """[tile row, tile column] depth at which rays end, in the same form."""
    rest = BufferDescription(np.int32)
    """Rays that those beside them do not tell, of raycast_between: their number, then _REST_ENTRY values of each."""


@dataclass(frozen=True)
class Surface:
    """Real geometry as seen by the camera, on the device, [h, w]."""

    positions: cl_array.Array
    """float4: volume space metres, w = 1 where there is surface, else 0."""
    normals: cl_array.Array
    """float4: unit, world axes, towards the camera; w as in `positions`."""
    labels: cl_array.Array
    """uint8: LABEL_NONE, LABEL_STATIC (from the volume), LABEL_DYNAMIC (from the sensor), LABEL_FILLED (from
    neighbours)."""


def raycast(
    engine: Engine,
    camera: CameraModel,
    volume_from_camera: NDArray[np.float64],
    volume: Volume,
    buffers: SurfaceBuffers | None = None,
) -> Surface:
    """Surface of the volume alone, in `buffers` (None: the engine's); labels are not filled."""
    buffers = buffers or engine.buffers(SurfaceBuffers)
    size, lanes = (camera.height, camera.width), engine.lanes
    positions = buffers.positions.array(size)
    normals = buffers.normals.array(size)
    view = (
        camera.width,
        camera.height,
        *volume.arguments(),
        intrinsics(camera),
        float16(volume_from_camera),
        GREATEST_DEPTH_M,
        *_ray_bounds(engine, camera, volume_from_camera, volume),
    )
    pixels = camera.width * camera.height
    rest = engine.buffers(_RayBuffers).rest.array((1 + _REST_ENTRY * pixels,))
    engine.fill(rest[:1], 0)
    squares = (-(-camera.width // (_SPACING * lanes)), -(-camera.height // _SPACING))
    engine.launch(_kernel(engine, "raycast"), squares, *view, positions, normals)
    engine.launch(_kernel(engine, "raycast_between"), squares, *view, positions, normals, rest)
    items, group = (_REST_ITEMS, 1) if lanes > 1 else (pixels, 64)
    engine.launch(_kernel(engine, "raycast_rest"), (items,), *view, items, rest, positions, normals, local=(group,))
    return Surface(positions, normals, buffers.labels.array(size))


def _ray_bounds(
    engine: Engine, camera: CameraModel, volume_from_camera: NDArray[np.float64], volume: Volume
) -> tuple[cl_array.Array, cl_array.Array]:
    """Nearest and farthest depth [tile row, tile column] with a solid voxel, as bits of float metres."""
    tiles = (-(-camera.height // _TILE), -(-camera.width // _TILE))
    buffers = engine.buffers(_RayBuffers)
    nearest, farthest = buffers.nearest.array(tiles), buffers.farthest.array(tiles)
    engine.fill(nearest, _FARTHEST)
    engine.fill(farthest, 0)
    if volume.allocated_bricks:
        engine.launch(
            _kernel(engine, "bound_rays"),
            (volume.allocated_bricks,),
            volume.allocated_bricks,
            camera.width,
            camera.height,
            int4(*volume.bricks, 0),
            volume.allocated_device,
            volume.solid,
            volume.voxel_m,
            intrinsics(camera),
            float16(inverse_rigid(volume_from_camera)),
            nearest,
            farthest,
        )
    return nearest, farthest


def _kernel(engine: Engine, name: str) -> cl.Kernel:
    return engine.kernel("raycast.cl", name, LANES=engine.lanes)
