"""Surface measurement (thesis 5.1.1): undistorts colour and depth, linearises colour, registers depth to colour.

Kernels: measure.cl, and register.cl if depth has a lens of its own.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import numpy as np
import pyopencl.array as cl_array
import pyopencl.cltypes as cl_types
from numpy.typing import NDArray

from protocol.frames import CameraModel, ColorEncoding, DepthCamera, RgbdFrame
from server.input.register import register_depth
from server.opencl.buffers import BufferDescription, StageBuffers
from server.opencl.engine import Engine, float4

GREATEST_DEPTH_M = 10.0
"""Range of depth cameras for rooms; larger values are treated as no measurement."""


class _Buffers(StageBuffers):
    received = BufferDescription(np.uint8)
    """Colour [h, w, 3] and depth [h, w] as received."""
    linear_values = BufferDescription(np.float32)
    """[256 or 65536] radiance of each code value."""
    radiance = BufferDescription(cl_types.float4)
    depth_m = BufferDescription(np.float32)


@dataclass(frozen=True)
class Measurement:
    """The rectified input on the device."""

    radiance: cl_array.Array
    """[h, w] float4: linear RGB, w = 1 usable, 0 black or clipped, -1 outside the picture."""
    depth_m: cl_array.Array
    """[h, w] float32 metres along the optical axis, 0 = none."""
    codes: cl_array.Array | None = None
    """[h, w, 3] uint8: the picture as it is shown; None where that is not what was received."""


@cache
def linear_values(encoding: ColorEncoding) -> NDArray[np.float32]:
    """Linear radiance in [0, 1] of each code value: [256] for sRGB (IEC 61966-2-1), [65536] for linear16."""
    if encoding == "linear16":
        return (np.arange(65536) / 65535).astype(np.float32)
    code = np.arange(256) / 255
    return np.where(code <= 0.04045, code / 12.92, ((code + 0.055) / 1.055) ** 2.4).astype(np.float32)


def intrinsics(lens: CameraModel | DepthCamera) -> np.generic:
    """(fx, fy, cx, cy) as a kernel argument."""
    return float4(lens.fx, lens.fy, lens.cx, lens.cy)


def measure(engine: Engine, camera: CameraModel, frame: RgbdFrame) -> Measurement:
    """Upload `frame` and rectify it. Its pictures must have the sizes of the camera's lenses."""
    buffers, shape = engine.buffers(_Buffers), (camera.height, camera.width)
    is_linear, one_lens = camera.color_encoding == "linear16", camera.depth is None
    received = buffers.received.upload_parts({"color": frame.color, "depth": frame.depth})
    codes, units = received.array("color"), received.array("depth")
    radiance = buffers.radiance.array(shape)
    depth_m = buffers.depth_m.array(shape) if one_lens else register_depth(engine, camera, units, GREATEST_DEPTH_M)
    engine.launch(
        engine.kernel("measure.cl", "measure", LINEAR16=is_linear, DISTORTED=camera.is_distorted, ONE_LENS=one_lens),
        shape[::-1],
        *shape[::-1],
        codes,
        buffers.linear_values.constant(linear_values(camera.color_encoding)),
        intrinsics(camera),
        _distortion(camera),
        units,
        camera.depth_scale_m,
        GREATEST_DEPTH_M,
        radiance,
        depth_m,
    )
    is_shown = not is_linear and not camera.is_distorted
    return Measurement(radiance, depth_m, codes if is_shown else None)


def _distortion(camera: CameraModel) -> np.generic:
    vector: np.generic = cl_types.make_float8(*camera.distortion, 0, 0, 0)  # type: ignore[attr-defined]
    return vector
