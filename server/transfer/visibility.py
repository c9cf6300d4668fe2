"""Visibility alone, without transfer, at samples of the surface (thesis 5.1.2). Kernel: visibility.cl."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pyopencl.array as cl_array

from protocol.frames import CameraModel
from server.opencl.buffers import BufferDescription, StageBuffers
from server.opencl.engine import Engine
from server.transfer.radiance_transfer import Directions
from server.volume.raycast import Surface
from server.volume.volume import Volume


class _Buffers(StageBuffers):
    free = BufferDescription(np.uint32)
    blocked = BufferDescription(np.uint32)


@dataclass(frozen=True)
class Visibility:
    """One bit a direction, [rows, cols, words] uint32, zeros where there is no surface."""

    free: cl_array.Array
    """Bit j: direction j lies above the surface, and no surface is met within the reach."""
    blocked: cl_array.Array
    """Bit j: direction j lies above the surface, and a surface is met."""


def trace_visibility(
    engine: Engine,
    camera: CameraModel,
    volume: Volume,
    surface: Surface,
    stride: int,
    rays: Directions,
    ray_length_m: float,
) -> Visibility:
    """From every `stride`-th pixel, one voxel off the surface (fig. 7.5), along rays of at most `ray_length_m`.

    Sample i along an axis lies at pixel stride / 2 + i stride. The arrays are reused by the next call.
    """
    cols, rows, words = camera.width // stride, camera.height // stride, -(-rays.count // 32)
    buffers, shape = engine.buffers(_Buffers), (rows, cols, words)
    result = Visibility(buffers.free.array(shape), buffers.blocked.array(shape))
    engine.launch(
        engine.kernel("visibility.cl", "trace_visibility", MASK_WORDS=words, LANES=engine.lanes),
        (cols, rows),
        cols,
        rows,
        stride,
        camera.width,
        surface.positions,
        surface.normals,
        *volume.arguments(),
        rays.count,
        rays.on_device(engine),
        ray_length_m,
        result.free,
        result.blocked,
    )
    return result
