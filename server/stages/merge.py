"""The hybrid geometry buffer (thesis 4.2.2, eq. 4.3): the volume's surface merged with what the sensor sees now.

Kernel: merge.cl.
"""

from __future__ import annotations

import numpy as np
import pyopencl.array as cl_array
from numpy.typing import NDArray

from protocol.frames import CameraModel
from server.maths.rigid import inverse_rigid
from server.opencl.engine import Engine, float16
from server.stages.measure import intrinsics
from server.stages.raycast import Surface


def merge_depth(
    engine: Engine,
    camera: CameraModel,
    volume_from_camera: NDArray[np.float64],
    depth_m: cl_array.Array,
    surface: Surface,
    voxel_m: float,
) -> Surface:
    """Replace the volume's surface by the sensor's where they disagree; fills the labels. Works in place."""
    engine.launch(
        engine.kernel("merge.cl", "merge_depth"),
        (camera.width, camera.height),
        camera.width,
        camera.height,
        depth_m,
        intrinsics(camera),
        float16(volume_from_camera),
        float16(inverse_rigid(volume_from_camera)),
        voxel_m,
        surface.positions,
        surface.normals,
        surface.labels,
    )
    return surface
