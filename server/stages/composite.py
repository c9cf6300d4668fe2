"""Compositing (thesis 7.2.1): the finished picture. Kernel: composite.cl."""

from __future__ import annotations

from functools import cache

import numpy as np
import pyopencl.array as cl_array
import pyopencl.cltypes as cl_types
from numpy.typing import NDArray

from protocol.frames import CameraModel
from server.maths.rigid import inverse_rigid
from server.opencl.engine import Engine, KernelArgument, float16
from server.stages.measure import linear_values
from server.stages.rasterize import SUBPIXELS, VirtualSurface
from server.stages.raycast import Surface
from server.stages.reached import mark_reached
from server.stages.sample_grid import SampleGrid
from server.stages.sampling import Upsampling
from server.stages.traced_scene import DeviceLight


def srgb_codes(linear: NDArray[np.float64]) -> NDArray[np.uint8]:
    """sRGB codes of linear radiance, clipped to [0, 1] (IEC 61966-2-1)."""
    clipped = np.clip(linear, 0.0, 1.0)
    encoded = np.where(clipped <= 0.0031308, 12.92 * clipped, 1.055 * clipped ** (1 / 2.4) - 0.055)
    return (255 * encoded + 0.5).astype(np.uint8)


@cache
def _shown_codes() -> NDArray[np.uint8]:
    return srgb_codes(linear_values("linear16").astype(np.float64))


def shown_picture(
    engine: Engine, camera: CameraModel, color: NDArray[np.uint8] | NDArray[np.uint16], radiance: cl_array.Array
) -> NDArray[np.uint8]:
    """[h, w, 3] the camera picture as sRGB codes: unchanged if it is sRGB, sRGB(value / 65535) if linear.

    A distorted camera's picture is shown rectified, because virtual things are drawn as a pinhole camera sees them.
    """
    if camera.is_distorted:
        rectified = engine.download(radiance)
        return srgb_codes(np.stack([rectified[channel] for channel in "xyz"], axis=-1).astype(np.float64))
    if camera.color_encoding == "linear16":
        return _shown_codes()[color]
    return color.astype(np.uint8, copy=False)


def composite(
    engine: Engine,
    camera: CameraModel,
    volume_from_camera: NDArray[np.float64],
    shown: NDArray[np.uint8],
    radiance: cl_array.Array,
    surface: Surface,
    tolerance_m: float,
    light: DeviceLight,
    virtual: VirtualSurface | None = None,
    occluded: SampleGrid | None = None,
    ratio: SampleGrid | None = None,
    refined_occluded: cl_array.Array | None = None,
    refined_ratio: cl_array.Array | None = None,
    upsampling: Upsampling = "bilateral",
    coverage: cl_array.Array | None = None,
    reflected: cl_array.Array | None = None,
    gain: float = 1.0,
    direct_virtual: cl_array.Array | None = None,
    direct_ratio: cl_array.Array | None = None,
    reached: cl_array.Array | None = None,
) -> NDArray[np.uint8]:
    """Picture [h, w, 3] sRGB of the camera picture `shown` with what is virtual; unchanged where nothing virtual is.

    `refined_occluded`, `refined_ratio` [h, w] float4: what stands for `occluded` and `ratio` where w = 1. `coverage`:
    of nearest_depths, for smooth edges; without it a pixel is covered as its middle is. `reflected`: of reflect.py.
    `gain`: by which virtual surface is brighter than `light` makes it (tone_mapping.py). `direct_virtual`:
    what the light's discs bring besides; `direct_ratio`: stands for `ratio` and `refined_ratio` then (shadow_map.py).
    `reached`: of reached.py, the cells in which `ratio` counts, None: wherever it is not 1.

    `tolerance_m`: how far behind a real surface a virtual one still shows, for objects that stand on it.
    """
    if virtual is None and ratio is None:
        return shown
    space = engine.workspace
    picture = space.array("picture", (camera.height, camera.width, 3), np.uint8)
    bands = round(light.coefficients.shape[0] ** 0.5)
    defines = {
        "HAS_OBJECTS": virtual is not None,
        "HAS_SHADOWS": ratio is not None,
        "BICUBIC": upsampling == "bicubic",
        "SUBPIXELS": 0 if coverage is None else SUBPIXELS,
        "HAS_GLOSS": reflected is not None,
        "HAS_DIRECT": bool(light.discs),
        "LANES": engine.lanes,
    }
    kernel = engine.kernel("composite.cl", "composite", BANDS=bands, **defines)
    unused = space.array("unused", (1,), cl_types.float4)
    if reached is None:
        reached = mark_reached(engine, camera, surface, ratio) if ratio and not light.discs else unused
    engine.launch(
        kernel,
        (-(-camera.width // engine.lanes), camera.height),
        camera.width,
        camera.height,
        space.upload("shown", shown),
        radiance,
        surface.positions,
        surface.normals,
        float16(inverse_rigid(volume_from_camera)),
        tolerance_m,
        *((virtual.position, virtual.normal, virtual.base_color) if virtual else (unused, unused, unused)),
        unused if coverage is None else coverage,
        unused if reflected is None else reflected,
        light.coefficients,
        gain,
        *_grid(occluded, unused),
        *_grid(ratio, unused),
        reached,
        refined_occluded is not None,
        unused if refined_occluded is None else refined_occluded,
        refined_ratio is not None,
        unused if refined_ratio is None else refined_ratio,
        unused if direct_virtual is None else direct_virtual,
        unused if direct_ratio is None else direct_ratio,
        space.constant("srgb_codes", _shown_codes()),
        picture,
    )
    return engine.download(picture)


def _grid(grid: SampleGrid | None, unused: cl_array.Array) -> tuple[KernelArgument, ...]:
    """cols, rows, stride, values."""
    return (grid.cols, grid.rows, grid.stride, grid.values) if grid else (0, 0, 1, unused)
