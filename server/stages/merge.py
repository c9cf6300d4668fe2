"""The hybrid geometry buffer (thesis 4.2.2, eq. 4.3): the volume's surface merged with what the sensor sees now.

Kernel: merge.cl.
"""

from __future__ import annotations

import numpy as np
import pyopencl.cltypes as cl_types
from numpy.typing import NDArray

from protocol.frames import CameraModel
from server.maths.rigid import inverse_rigid
from server.opencl.engine import Engine, float16
from server.stages.measure import Measurement, intrinsics
from server.stages.raycast import Surface


def merge_depth(
    engine: Engine,
    camera: CameraModel,
    volume_from_camera: NDArray[np.float64],
    measurement: Measurement,
    model: Surface,
    voxel_m: float,
) -> Surface:
    """The volume's surface, replaced by the sensor's where they disagree, in buffers of its own."""
    size, space = (camera.height, camera.width), engine.workspace
    surface = Surface(
        space.array("merged_positions", size, cl_types.float4),
        space.array("merged_normals", size, cl_types.float4),
        space.array("labels", size, np.uint8),
    )
    engine.launch(
        engine.kernel("merge.cl", "merge_depth"),
        (camera.width, camera.height),
        camera.width,
        camera.height,
        measurement.depth_m,
        intrinsics(camera),
        float16(volume_from_camera),
        float16(inverse_rigid(volume_from_camera)),
        voxel_m,
        model.positions,
        model.normals,
        surface.positions,
        surface.normals,
        surface.labels,
    )
    return surface
