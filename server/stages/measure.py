"""Measure the input (thesis 5.1.1): undistort colour and depth, remove the gamma. Kernel: measure.cl."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import numpy as np
import pyopencl.array as cl_array
import pyopencl.cltypes as cl_types
from numpy.typing import NDArray

from protocol.frames import CameraModel, ColorEncoding, RgbdFrame
from server.opencl.engine import Engine, float4

GREATEST_DEPTH_M = 10.0
"""Beyond it no depth camera for rooms measures anything; larger values are taken as no measurement."""


@dataclass(frozen=True)
class Measurement:
    """The rectified input on the device."""

    radiance: cl_array.Array
    """[h, w] float4: linear RGB, w = 1 usable, 0 black or clipped, -1 outside the picture."""
    depth_m: cl_array.Array
    """[h, w] float32 metres along the optical axis, 0 = none."""


@cache
def linear_values(encoding: ColorEncoding) -> NDArray[np.float32]:
    """Linear radiance in [0, 1] of every code value: 256 of sRGB (IEC 61966-2-1) or 65536 of linear16."""
    if encoding == "linear16":
        return (np.arange(65536) / 65535).astype(np.float32)
    code = np.arange(256) / 255
    return np.where(code <= 0.04045, code / 12.92, ((code + 0.055) / 1.055) ** 2.4).astype(np.float32)


def intrinsics(camera: CameraModel) -> np.generic:
    """(fx, fy, cx, cy) as a kernel argument."""
    return float4(camera.fx, camera.fy, camera.cx, camera.cy)


def measure(engine: Engine, camera: CameraModel, frame: RgbdFrame) -> Measurement:
    """Upload `frame` and rectify it. The frame's arrays must have the camera's size."""
    size = (camera.height, camera.width)
    space = engine.workspace
    radiance = space.array("radiance", size, cl_types.float4)
    depth_m = space.array("depth_m", size, np.float32)
    kernel = engine.kernel(
        "measure.cl", "measure", LINEAR16=camera.color_encoding == "linear16", DISTORTED=camera.is_distorted
    )
    engine.launch(
        kernel,
        (camera.width, camera.height),
        camera.width,
        camera.height,
        space.upload("color_codes", frame.color),
        space.upload("depth_units", frame.depth),
        space.constant("linear_values", linear_values(camera.color_encoding)),
        intrinsics(camera),
        cl_types.make_float8(*camera.distortion, 0, 0, 0),  # type: ignore[attr-defined]
        camera.depth_scale_m,
        GREATEST_DEPTH_M,
        radiance,
        depth_m,
    )
    return Measurement(radiance, depth_m)
