"""Image of the scanned surface for clients without a camera. Kernel: view_colors.cl."""

from __future__ import annotations

import numpy as np
import pyopencl.array as cl_array
import pyopencl.cltypes as cl_types

from protocol.frames import CameraModel
from server.opencl.buffers import BufferDescription, StageBuffers
from server.opencl.engine import Engine, int4
from server.volume.raycast import Surface
from server.volume.volume import Volume


class _Buffers(StageBuffers):
    radiance = BufferDescription(cl_types.float4)


def view_colors(engine: Engine, camera: CameraModel, surface: Surface, volume: Volume) -> cl_array.Array:
    """[h, w] float4: the volume's radiance on the surface, in units of the first picture; w = 0: unknown."""
    radiance = engine.buffers(_Buffers).radiance.array((camera.height, camera.width))
    engine.launch(
        engine.kernel("view_colors.cl", "view_colors"),
        (camera.width, camera.height),
        camera.width,
        camera.height,
        int4(*volume.bricks, 0),
        volume.slots_device,
        volume.colors,
        np.float32(volume.voxel_m),
        surface.positions,
        radiance,
    )
    return radiance
