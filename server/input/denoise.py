"""Denoising (thesis 5.1.1): of lightness by TV-L1 (its [120]) or a bilateral filter, of depth by the bilateral filter.

Kernel: denoise.cl.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from typing import Literal

import numpy as np
import pyopencl.array as cl_array
import pyopencl.cltypes as cl_types
from numpy.typing import NDArray

from server.input.measure import Measurement
from server.opencl.buffers import BufferDescription, BufferGroup, StageBuffers
from server.opencl.engine import Engine, float4

DenoiseMethod = Literal["none", "bilateral", "tv_l1"]

NO_LIGHTNESS = -1.0
"""Lightness of pixels without a usable colour: outside the picture, black or clipped."""
PRIMAL_STEP = 0.01
"""Primal step relative to the contrast: of 0.01 to 0.2, the one with the least energy after 5 to 100 iterations."""
LIGHTNESS_WEIGHT = 0.8
RADIUS_PX = 3
_CLOSENESS_PX = 2.0
_DEPTH_WIDTH = (8 * 0.0012, 8 * 0.0019, 0.4)
_LIGHTNESS_WIDTH = 0.08  # four deviations of a noisy camera, 0.02
_STRIPS_PER_CORE, _LEAST_STRIP_ROWS, _STEPS = 3, 16, 6
_MARGIN_PX = 8  # as in the kernel


class _StateBuffers(StageBuffers):
    u = BufferDescription(np.float32)
    """[h + 1, stride] the image."""
    ahead = BufferDescription(np.float32)
    """[h + 1, stride] the extrapolated image."""
    px = BufferDescription(np.float32)
    """[h + 1, stride] the dual field along x."""
    py = BufferDescription(np.float32)
    """[h + 1, stride] along y."""

    def arrays(self, shape: tuple[int, int]) -> tuple[cl_array.Array, ...]:
        """In the order in which the kernels take them."""
        return tuple(buffer.array(shape) for buffer in (self.u, self.ahead, self.px, self.py))


class _Buffers(StageBuffers):
    f = BufferDescription(np.float32)
    """[h + 1, stride] the noisy image."""
    joined = BufferDescription(np.uint8)
    """[h + 1, stride] bits: whether a pixel is joined to its right and to its lower neighbour."""
    first_state = BufferGroup(_StateBuffers)
    second_state = BufferGroup(_StateBuffers)
    scratch = BufferDescription(np.float32)
    """[strip, 4, row, stride] the state within a strip."""
    smooth = BufferDescription(np.float32)
    """[h, w] result of TV-L1."""
    padded = BufferDescription(np.float32)
    """[h + 2 RADIUS_PX, stride] input of the bilateral filter, with a border of `none`."""
    closeness = BufferDescription(np.float32)
    filtered = BufferDescription(np.float32)
    """[h, w] result of the bilateral filter."""
    lightness = BufferDescription(np.float32)
    relit = BufferDescription(cl_types.float4)


@dataclass(frozen=True)
class _Problem:
    """One TV-L1 problem on the device; arrays are [h + 1, stride]."""

    stride: int
    height: int
    f: cl_array.Array
    joined: cl_array.Array
    tau: float
    """Primal step."""
    limit: float
    """tau times the weight."""

    @property
    def sigma(self) -> float:
        """Dual step; 8 is the largest eigenvalue of div grad."""
        return 1 / (8 * self.tau)


def tv_l1(
    engine: Engine,
    image: cl_array.Array,
    iterations: int,
    weight: float,
    none: float = -np.inf,
    *,
    contrast: float = 1.0,
    edge: float = float(np.inf),
    strips: bool | None = None,
) -> cl_array.Array:
    """[h, w] float32 with less of TV(u) + weight |u - image|_1 after each of `iterations` (Chambolle and Pock 2011).

    image: [h, w] float32, finite. Pixels at or below `none` are unknown: they stay unchanged, and nothing spreads
    across them, nor between neighbours that differ by more than `edge`. `contrast`: difference across the picture's
    edges, in its unit; changes the speed of convergence only. `strips`: use the kernel for CPUs, else the ones for
    GPUs; None: chosen by the device. The result is valid until the next call.
    """
    height, width = image.shape
    stride = 8 * (width // 8 + 1)
    buffers, shape, tau = engine.buffers(_Buffers), (height + 1, stride), PRIMAL_STEP * contrast
    f, joined = buffers.f.array(shape), buffers.joined.array(shape)
    problem = _Problem(stride, height, f, joined, tau, weight * tau)
    start = buffers.first_state.arrays(shape)
    prepare, finish = (engine.kernel("denoise.cl", name) for name in ("tv_l1_prepare", "tv_l1_finish"))
    engine.launch(prepare, (stride, height), width, height, stride, image, none, edge, f, joined, *start)
    in_strips = not engine.device.is_gpu if strips is None else strips
    u = (_iterate_in_strips if in_strips else _iterate_in_passes)(engine, problem, iterations, start)
    result = buffers.smooth.array((height, width))
    engine.launch(finish, (width, height), width, height, stride, u, result)
    return result


def _iterate_in_strips(
    engine: Engine, problem: _Problem, iterations: int, start: tuple[cl_array.Array, ...]
) -> cl_array.Array:
    """u after `iterations`; up to _STEPS of them in one pass over memory."""
    stride, height, f, joined = problem.stride, problem.height, problem.f, problem.joined
    cores = engine.device.context.devices[0].max_compute_units
    rows = max(_LEAST_STRIP_ROWS, -(-height // (_STRIPS_PER_CORE * cores)))
    strips = -(-height // rows)
    scratch = engine.buffers(_Buffers).scratch.array((strips, 4, rows + 2 * _STEPS + 1, stride))
    kernel = engine.kernel("denoise.cl", "tv_l1_strips")
    old, new = start, engine.buffers(_Buffers).second_state.arrays((height + 1, stride))
    while iterations > 0:
        steps = min(_STEPS, iterations)
        numbers = (problem.tau, problem.sigma, problem.limit)
        engine.launch(
            kernel, (strips,), stride, height, rows, steps, f, joined, *numbers, *old, scratch, *new, local=(1,)
        )
        old, new = new, old
        iterations -= steps
    return old[0]


def _iterate_in_passes(
    engine: Engine, problem: _Problem, iterations: int, start: tuple[cl_array.Array, ...]
) -> cl_array.Array:
    """u after `iterations`, in place."""
    u, ahead, px, py = start
    size = problem.stride, problem.height
    dual, primal = (engine.kernel("denoise.cl", name) for name in ("tv_l1_dual", "tv_l1_primal"))
    for _ in range(iterations):
        engine.launch(dual, size, *size, problem.joined, problem.sigma, ahead, px, py)
        engine.launch(primal, size, *size, problem.f, problem.tau, problem.limit, px, py, u, ahead)
    return u


def bilateral(
    engine: Engine, image: cl_array.Array, range_width: tuple[float, float, float], none: float
) -> cl_array.Array:
    """[h, w] float32: weighted mean of those of 7 x 7 pixels that differ from a pixel's value v by less than
    w[0] + w[1] (v - w[2])^2, w = range_width, and by less than half of v - none. none: the value of no measurement.

    image: [h, w] float32, nowhere below `none`. The result is valid until the next call.
    """
    height, width = image.shape
    stride, buffers = 8 * -(-width // 8) + 2 * _MARGIN_PX, engine.buffers(_Buffers)
    padded = buffers.padded.array((height + 2 * RADIUS_PX, stride))
    filtered = buffers.filtered.array((height, width))
    engine.launch(
        engine.kernel("denoise.cl", "pad"), padded.shape[::-1], width, height, stride, image, float(none), padded
    )
    engine.launch(
        engine.kernel("denoise.cl", "bilateral"),
        (-(-width // 8), height),
        width,
        height,
        stride,
        padded,
        buffers.closeness.constant(closeness()),
        float4(*range_width, 0),
        float(none),
        filtered,
    )
    return filtered


@cache
def closeness() -> NDArray[np.float32]:
    """[7, 7] weight by distance in pixels, a Gaussian."""
    across = np.exp(-0.5 * (np.arange(-RADIUS_PX, RADIUS_PX + 1) / _CLOSENESS_PX) ** 2)
    return np.outer(across, across).astype(np.float32)


def bilateral_depth(engine: Engine, depth_m: cl_array.Array) -> cl_array.Array:
    """Depth [h, w] metres, 0 = none, averaged within eight deviations of the sensor's noise (Nguyen et al. 2012, 3).

    0 stays 0. The result is valid until the next bilateral filter.
    """
    return bilateral(engine, depth_m, _DEPTH_WIDTH, 0.0)


def measure_lightness(engine: Engine, radiance: cl_array.Array) -> cl_array.Array:
    """CIE L* / 100 [h, w] of linear RGB [h, w] float4 relative to white = 1; NO_LIGHTNESS where w <= 0."""
    lightness = engine.buffers(_Buffers).lightness.array(radiance.shape)
    kernel = engine.kernel("denoise.cl", "measure_lightness")
    engine.launch(kernel, (-(-radiance.size // 8),), radiance.size, radiance, lightness)
    return lightness


def relight(engine: Engine, radiance: cl_array.Array, lightness: cl_array.Array) -> cl_array.Array:
    """`radiance` [h, w] float4 with its usable colours scaled to the lightness [h, w].

    The result is valid until the next call.
    """
    relit = engine.buffers(_Buffers).relit.array(radiance.shape)
    kernel = engine.kernel("denoise.cl", "relight")
    engine.launch(kernel, (-(-radiance.size // 8),), radiance.size, radiance, lightness, relit)
    return relit


def denoise_radiance(
    engine: Engine, measurement: Measurement, method: DenoiseMethod, iterations: int = 20
) -> cl_array.Array:
    """Radiance [h, w] float4 like `measurement.radiance`, its lightness denoised, the ratios of its colours kept.

    Unusable pixels stay unchanged and do not affect others. The result is valid until the next call; with method "none"
    it is the measurement's own array.
    """
    if method == "none":
        return measurement.radiance
    lightness = measure_lightness(engine, measurement.radiance)
    if method == "bilateral":
        smooth = bilateral(engine, lightness, (_LIGHTNESS_WIDTH, 0.0, 0.0), NO_LIGHTNESS)
    else:
        smooth = tv_l1(engine, lightness, iterations, LIGHTNESS_WEIGHT, NO_LIGHTNESS)
    return relight(engine, measurement.radiance, smooth)
