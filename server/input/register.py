"""Registration of depth from another lens to the colour picture (thesis 5.1.1). Kernel: register.cl.

Each depth pixel is projected along its own ray. The depth picture is not resampled, so that no measurement is lost.
"""

from __future__ import annotations

import math
from functools import lru_cache

import numpy as np
import pyopencl.array as cl_array
import pyopencl.cltypes as cl_types
from numpy.typing import NDArray

from protocol.frames import CameraModel, DepthCamera
from protocol.limits import MAX_IMAGE_SIDE_PX
from server.opencl.buffers import BufferDescription, KeyedBufferDescription, StageBuffers
from server.opencl.engine import Engine, float4, float16

_NEWTON_STEPS = 20
_CLOSE = 1e-9
_SPREAD = 4.0
"""Greatest size of a triangle between neighbouring depth pixels, relative to one seen from the front."""


class _Buffers(StageBuffers):
    rays = KeyedBufferDescription(np.float32)
    """By depth lens, [h, w, 4] as rays_of returns them."""
    projected = BufferDescription(cl_types.float4)
    """[h, w] of the depth lens: pixel in the colour picture, 1 / z there, z in the depth camera; 0 = none."""
    surface = BufferDescription(np.uint32)
    """[h, w] bits of the depth of triangles between measurements."""
    points = BufferDescription(np.uint32)
    """[h, w] bits of the depth of single measurements."""
    depth_m = BufferDescription(np.float32)
    """[h, w] the result."""


def register_depth(
    engine: Engine, camera: CameraModel, units: cl_array.Array, greatest_depth_m: float
) -> cl_array.Array:
    """[h, w] float32 of the colour picture: metres along its axis of the nearest surface measured there, 0 = none.

    units: [h, w] uint16 of `camera.depth`, which must be set; 0 and 65535: none. Surfaces are interpolated between
    measurements, but not across depth edges. The result is valid until the next call.
    """
    lens = camera.depth
    assert lens is not None
    projected = _project(engine, camera, lens, units, greatest_depth_m)
    size, buffers = (camera.height, camera.width), engine.buffers(_Buffers)
    surface, points = buffers.surface.array(size), buffers.points.array(size)
    count, focal_px = camera.width * camera.height, math.sqrt(lens.fx * lens.fy)
    engine.launch(engine.kernel("register.cl", "clear_depth"), (count,), count, surface, points)
    engine.launch(
        engine.kernel("register.cl", "splat_surface"),
        (lens.width - 1, lens.height - 1),
        lens.width,
        lens.height,
        projected,
        focal_px,
        camera.width,
        camera.height,
        _greatest_px(camera, lens),
        surface,
    )
    splat_points, resolve = (engine.kernel("register.cl", name) for name in ("splat_points", "resolve_depth"))
    engine.launch(splat_points, (projected.size,), projected.size, projected, camera.width, camera.height, points)
    depth_m = buffers.depth_m.array(size)
    engine.launch(resolve, (count,), count, surface, points, focal_px, greatest_depth_m, depth_m)
    return depth_m


def _project(
    engine: Engine, camera: CameraModel, lens: DepthCamera, units: cl_array.Array, greatest_depth_m: float
) -> cl_array.Array:
    """[h, w] float4 of the depth lens: pixel in the colour picture, 1 / z there, z in the depth camera; 0 = none."""
    buffers = engine.buffers(_Buffers)
    projected = buffers.projected.array((lens.height, lens.width))
    engine.launch(
        engine.kernel("register.cl", "project_depth"),
        (lens.width, lens.height),
        lens.width,
        lens.height,
        units,
        buffers.rays[lens].constant(rays_of(lens)),
        camera.depth_scale_m,
        greatest_depth_m,
        float16(camera.color_from_depth),
        float4(camera.fx, camera.fy, camera.cx, camera.cy),
        projected,
    )
    return projected


def _greatest_px(camera: CameraModel, lens: DepthCamera) -> int:
    return math.ceil(min(_SPREAD * max(camera.fx / lens.fx, camera.fy / lens.fy), MAX_IMAGE_SIDE_PX)) + 2


@lru_cache(maxsize=8)
def rays_of(lens: DepthCamera) -> NDArray[np.float32]:
    """[h, w, 4] (x, y, 1, 0): the ray at z = 1 of every pixel of the distorted picture; z = 0: no ray.

    Newton's method on Brown's polynomial, from the distorted point. Where the polynomial folds back there is no ray.
    """
    v, u = np.mgrid[: lens.height, : lens.width].astype(np.float64)
    distorted = np.stack([(u - lens.cx) / lens.fx, (v - lens.cy) / lens.fy], axis=-1)
    found = distorted.copy()
    with np.errstate(all="ignore"):  # may diverge beyond the fold; such pixels get no ray
        for _ in range(_NEWTON_STEPS):
            off, jacobian = _distorted(lens, found)
            found -= _solve_2x2(jacobian, off - distorted)
        off, jacobian = _distorted(lens, found)
        converged = (
            (np.abs(off - distorted).max(-1) < _CLOSE) & (_determinant(jacobian) > 0) & (jacobian[..., 0, 0] > 0)
        )
    rays = np.zeros((*converged.shape, 4), np.float32)
    rays[converged, :2] = found[converged]
    rays[converged, 2] = 1.0
    return rays


def _distorted(lens: DepthCamera, point: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Brown's polynomial at points [..., 2], and its Jacobian [..., 2, 2]."""
    k1, k2, p1, p2, k3 = lens.distortion
    x, y = point[..., 0], point[..., 1]
    r2 = x * x + y * y
    radial, slope = 1 + r2 * (k1 + r2 * (k2 + r2 * k3)), 2 * (k1 + r2 * (2 * k2 + 3 * r2 * k3))
    off_x = x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x)
    off_y = y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y
    mixed = x * y * slope + 2 * p1 * x + 2 * p2 * y
    rows = (
        (radial + x * x * slope + 2 * p1 * y + 6 * p2 * x, mixed),
        (mixed, radial + y * y * slope + 6 * p1 * y + 2 * p2 * x),
    )
    return np.stack([off_x, off_y], axis=-1), np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


def _determinant(m: NDArray[np.float64]) -> NDArray[np.float64]:
    result: NDArray[np.float64] = m[..., 0, 0] * m[..., 1, 1] - m[..., 0, 1] * m[..., 1, 0]
    return result


def _solve_2x2(m: NDArray[np.float64], b: NDArray[np.float64]) -> NDArray[np.float64]:
    x = m[..., 1, 1] * b[..., 0] - m[..., 0, 1] * b[..., 1]
    y = m[..., 0, 0] * b[..., 1] - m[..., 1, 0] * b[..., 0]
    return np.stack([x, y], axis=-1) / _determinant(m)[..., None]
