"""TSDF integration (KinectFusion; thesis 4.2.1): fuses a depth image into the volume. Kernel: integrate.cl."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from protocol.frames import CameraModel
from server.input.measure import Measurement, intrinsics
from server.maths.rigid import inverse_rigid
from server.opencl.engine import Engine, float16, int4
from server.volume.volume import Volume

GREATEST_WEIGHT = 64.0
"""Limit of a voxel's weight: beyond it, the running mean has a time constant of as many frames."""


def integrate(
    engine: Engine,
    volume: Volume,
    camera: CameraModel,
    volume_from_camera: NDArray[np.float64],
    measurement: Measurement,
    *,
    with_shape: bool = True,
) -> None:
    """Fuse a rectified depth image and its colours into the allocated bricks.

    with_shape: else its colours alone, of the picture that was fused last.
    """
    if not volume.allocated_bricks:
        return
    items = 64 if engine.lanes == 1 else 1  # on a CPU, one work-item does a whole brick
    engine.launch(
        engine.kernel("integrate.cl", "integrate", LANES=engine.lanes),
        (items * volume.allocated_bricks,),
        volume.allocated_bricks,
        camera.width,
        camera.height,
        int4(*volume.bricks, 0),
        volume.allocated_device,
        volume.slots_device,
        measurement.depth_m,
        measurement.radiance,
        intrinsics(camera),
        float16(inverse_rigid(volume_from_camera)),
        volume.voxel_m,
        volume.truncation_m,
        GREATEST_WEIGHT,
        volume.frames,
        with_shape,
        volume.voxels,
        volume.colors,
        volume.solid,
        volume.octets,
        local=(items,),
    )
    if not with_shape:
        volume.written = engine.mark()
        return
    volume.count_frame()
    volume.note_picture(camera, volume_from_camera)
    volume.update_tables()
