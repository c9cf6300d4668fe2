"""Where in the picture virtual objects change real surface visibly (thesis 7.1).

Kernel: change_mask.cl.
"""

from __future__ import annotations

import numpy as np
import pyopencl.array as cl_array

from protocol.frames import CameraModel
from server.opencl.engine import Engine
from server.transfer.sample_grid import SampleGrid
from server.transfer.sampling import Upsampling
from server.volume.raycast import Surface


def mark_changes(
    engine: Engine,
    camera: CameraModel,
    surface: Surface,
    ratio: SampleGrid,
    refined: cl_array.Array | None = None,
    tolerance_m: float = 1.0,
    spare: float = 0.0,
    upsampling: Upsampling = "bilateral",
) -> cl_array.Array:
    """[rows + 1, cols + 1] uint8: 0 where every pixel's R' / R differs from 1 by at most `spare`.

    The cells are those of upsample.clh; the first lies before the first sample. ratio: R' / R at samples; refined:
    [h, w] float4, replaces it where w = 1; tolerance_m: of upsampling, used where spare > 0.
    """
    changed = engine.array_to_read((ratio.rows + 1, ratio.cols + 1), np.uint8)
    defines = {"BICUBIC": 1} if upsampling == "bicubic" else {}
    engine.launch(
        engine.kernel("change_mask.cl", "mark_reached", **defines),
        (ratio.cols + 1, ratio.rows + 1),
        ratio.cols,
        ratio.rows,
        ratio.stride,
        camera.width,
        camera.height,
        surface.positions,
        surface.normals,
        ratio.values,
        refined is not None,
        ratio.values if refined is None else refined,
        tolerance_m,
        spare,
        changed,
    )
    return changed
