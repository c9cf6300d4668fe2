"""Surface prediction (KinectFusion; thesis 4.2.1): what of the volume a camera sees. Kernel: raycast.cl."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pyopencl.array as cl_array
import pyopencl.cltypes as cl_types
from numpy.typing import NDArray

from protocol.frames import CameraModel
from server.opencl.engine import Engine, float16
from server.stages.measure import GREATEST_DEPTH_M, intrinsics
from server.stages.volume import Volume

LABEL_NONE, LABEL_STATIC, LABEL_DYNAMIC = 0, 1, 2


@dataclass(frozen=True)
class Surface:
    """Real geometry seen by the camera, on the device, [h, w]."""

    positions: cl_array.Array
    """float4: volume space metres, w = 1 where there is surface, else 0."""
    normals: cl_array.Array
    """float4: unit, world axes, towards the camera, w likewise."""
    labels: cl_array.Array
    """uint8: LABEL_NONE, LABEL_STATIC (from the volume), LABEL_DYNAMIC (from the sensor)."""


def raycast(engine: Engine, camera: CameraModel, volume_from_camera: NDArray[np.float64], volume: Volume) -> Surface:
    """Surface of the volume alone; labels are not filled."""
    size = (camera.height, camera.width)
    positions = engine.workspace.array("positions", size, cl_types.float4)
    normals = engine.workspace.array("normals", size, cl_types.float4)
    engine.launch(
        engine.kernel("raycast.cl", "raycast"),
        (camera.width, camera.height),
        camera.width,
        camera.height,
        *volume.arguments(),
        intrinsics(camera),
        float16(volume_from_camera),
        GREATEST_DEPTH_M,
        positions,
        normals,
    )
    return Surface(positions, normals, engine.workspace.array("model_labels", size, np.uint8))
