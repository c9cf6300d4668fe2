"""Noise out of lightness and depth (thesis 5.1.1): TV-L1 (its [120]) or a bilateral filter. Kernel: denoise.cl.

Depth is filtered by TV-L1 as its inverse: there a plane is a straight ramp, and the noise of stereo and structured
light is the same near and far.
"""

from __future__ import annotations

from functools import cache
from typing import Literal

import numpy as np
import pyopencl.array as cl_array
import pyopencl.cltypes as cl_types
from numpy.typing import NDArray

from server.input.measure import Measurement
from server.opencl.engine import Engine, float4

DenoiseMethod = Literal["none", "bilateral", "tv_l1"]

NO_LIGHTNESS = -1.0
"""Lightness where there is none: a pixel outside the picture, black or clipped."""
PRIMAL_STEP = 0.01
"""Step of the picture relative to its contrast: of 0.01 to 0.2 it leaves the least energy in 5 to 100 iterations."""
LIGHTNESS_WEIGHT = 0.8
DEPTH_WEIGHT = 0.05
DEPTH_CONTRAST_PER_M = 0.02
"""Of inverse depth. With it and the weight, 20 iterations smooth a structured-light sensor's steps; hundreds would turn
slopes into stairs, which have no more variation than a ramp."""
DEPTH_EDGE_PER_M = 0.03
"""Difference of inverse depth that belongs to two surfaces: 3 cm at 1 m, 27 cm at 3 m."""
RADIUS_PX = 3
_CLOSENESS_PX = 2.0
_DEPTH_REACH_M = (8 * 0.0012, 8 * 0.0019, 0.4)
_LIGHTNESS_REACH = 0.08  # four deviations of a noisy camera, 2 of 100
_STRIPS_PER_CORE, _LEAST_STRIP_ROWS, _STEPS = 3, 16, 6
_MARGIN_PX = 8  # as in the kernel


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

    image: [h, w] float32, finite; nothing is known of pixels at or below `none`: they stay as they are, and nothing
    spreads across them, nor between neighbours that differ by more than `edge`. `contrast`: difference across the
    picture's edges, in its unit; sets how fast, not where to.
    `strips`: the kernel for processors with caches, or the one for GPUs; None: what fits the device. The result is
    valid until the next call.
    """
    height, width = image.shape
    stride = 8 * (width // 8 + 1)
    space, shape = engine.workspace, (height + 1, stride)
    tau = PRIMAL_STEP * contrast
    f = space.array("tv_l1_f", shape, np.float32)
    joined = space.array("tv_l1_joined", shape, np.uint8)
    states = [[space.array(f"tv_l1_{name}{k}", shape, np.float32) for name in ("u", "ahead", "px", "py")] for k in "01"]
    prepare, finish = (engine.kernel("denoise.cl", name) for name in ("tv_l1_prepare", "tv_l1_finish"))
    engine.launch(prepare, (stride, height), width, height, stride, image, none, edge, f, joined, *states[0])
    in_strips = not engine.device.is_gpu if strips is None else strips
    iterate = _iterate_in_strips if in_strips else _iterate_in_passes
    u = iterate(engine, (stride, height), iterations, f, joined, tau, weight * tau, states)
    result = space.array("tv_l1", (height, width), np.float32)
    engine.launch(finish, (width, height), width, height, stride, u, result)
    return result


def _iterate_in_strips(
    engine: Engine,
    size: tuple[int, int],
    iterations: int,
    f: cl_array.Array,
    joined: cl_array.Array,
    tau: float,
    limit: float,
    states: list[list[cl_array.Array]],
) -> cl_array.Array:
    """u after `iterations` from the first of two states; several of them in one pass over memory."""
    stride, height = size
    cores = engine.device.context.devices[0].max_compute_units
    rows = max(_LEAST_STRIP_ROWS, -(-height // (_STRIPS_PER_CORE * cores)))
    strips = -(-height // rows)
    scratch = engine.workspace.array("tv_l1_scratch", (strips, 4, rows + 2 * _STEPS + 1, stride), np.float32)
    kernel = engine.kernel("denoise.cl", "tv_l1_strips")
    old, new = states
    while iterations > 0:
        steps = min(_STEPS, iterations)
        numbers = (tau, _dual_step(tau), limit)
        engine.launch(
            kernel, (strips,), stride, height, rows, steps, f, joined, *numbers, *old, scratch, *new, local=(1,)
        )
        old, new = new, old
        iterations -= steps
    return old[0]


def _iterate_in_passes(
    engine: Engine,
    size: tuple[int, int],
    iterations: int,
    f: cl_array.Array,
    joined: cl_array.Array,
    tau: float,
    limit: float,
    states: list[list[cl_array.Array]],
) -> cl_array.Array:
    """u after `iterations`, in place."""
    u, ahead, px, py = states[0]
    dual, primal = (engine.kernel("denoise.cl", name) for name in ("tv_l1_dual", "tv_l1_primal"))
    for _ in range(iterations):
        engine.launch(dual, size, *size, joined, _dual_step(tau), ahead, px, py)
        engine.launch(primal, size, *size, f, tau, limit, px, py, u, ahead)
    return u


def _dual_step(tau: float) -> float:
    return 1 / (8 * tau)  # 8: the largest eigenvalue of div grad


def bilateral(engine: Engine, image: cl_array.Array, reach: tuple[float, float, float], none: float) -> cl_array.Array:
    """[h, w] float32: weighted mean of 7 x 7 pixels, of those that differ by less than the reach at a pixel's value v,
    reach[0] + reach[1] (v - reach[2])^2, and less than half its distance from `none`, the value of no measurement.

    image: [h, w] float32, nowhere below `none`. The result is valid until the next call.
    """
    height, width = image.shape
    stride, space = 8 * -(-width // 8) + 2 * _MARGIN_PX, engine.workspace
    padded = space.array("bilateral_padded", (height + 2 * RADIUS_PX, stride), np.float32)
    filtered = space.array("bilateral", (height, width), np.float32)
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
        space.constant("bilateral_closeness", closeness()),
        float4(*reach, 0),
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

    None stays none. The result is valid until the next filter.
    """
    return bilateral(engine, depth_m, _DEPTH_REACH_M, 0.0)


def tv_l1_depth(
    engine: Engine, depth_m: cl_array.Array, iterations: int = 20, weight: float = DEPTH_WEIGHT
) -> cl_array.Array:
    """Depth [h, w] metres, 0 = none, with the inverse depth denoised by TV-L1.

    None stays none. The result is valid until the next filter.
    """
    inverse = _inverted(engine, depth_m, "inverse_depth")
    smooth = tv_l1(engine, inverse, iterations, weight, 0.0, contrast=DEPTH_CONTRAST_PER_M, edge=DEPTH_EDGE_PER_M)
    return _inverted(engine, smooth, "tv_l1_depth_m")


def _inverted(engine: Engine, image: cl_array.Array, name: str) -> cl_array.Array:
    result = engine.workspace.array(name, image.shape, np.float32)
    engine.launch(engine.kernel("denoise.cl", "invert"), (image.size,), image.size, image, result)
    return result


def measure_lightness(engine: Engine, radiance: cl_array.Array) -> cl_array.Array:
    """CIE L* / 100 [h, w] of linear RGB [h, w] float4 relative to white = 1; NO_LIGHTNESS where w <= 0."""
    lightness = engine.workspace.array("lightness", radiance.shape, np.float32)
    kernel = engine.kernel("denoise.cl", "measure_lightness")
    engine.launch(kernel, (-(-radiance.size // 8),), radiance.size, radiance, lightness)
    return lightness


def relight(engine: Engine, radiance: cl_array.Array, lightness: cl_array.Array) -> cl_array.Array:
    """`radiance` [h, w] float4 with its usable colours scaled to `lightness` [h, w].

    The result is valid until the next call.
    """
    relit = engine.workspace.array("smooth_radiance", radiance.shape, cl_types.float4)
    kernel = engine.kernel("denoise.cl", "relight")
    engine.launch(kernel, (-(-radiance.size // 8),), radiance.size, radiance, lightness, relit)
    return relit


def denoise_radiance(
    engine: Engine, measurement: Measurement, method: DenoiseMethod, iterations: int = 20
) -> cl_array.Array:
    """Radiance [h, w] float4 like `measurement.radiance`, its lightness denoised, the ratios of its colours kept.

    Pixels that are not usable stay as they are and give nothing to others. The result is valid until the next call;
    with method "none" it is the measurement's own array.
    """
    if method == "none":
        return measurement.radiance
    lightness = measure_lightness(engine, measurement.radiance)
    if method == "bilateral":
        smooth = bilateral(engine, lightness, (_LIGHTNESS_REACH, 0.0, 0.0), NO_LIGHTNESS)
    else:
        smooth = tv_l1(engine, lightness, iterations, LIGHTNESS_WEIGHT, NO_LIGHTNESS)
    return relight(engine, measurement.radiance, smooth)
