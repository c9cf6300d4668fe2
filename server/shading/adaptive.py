"""Adaptive refinement (thesis 6.1.1, step 1): shading at every pixel where virtual objects make it vary.

Kernels: adaptive.cl. Virtual surface is refined at its edges of depth and normal. On real surface the thesis refines
what rays from the virtual objects hit. Here the samples already give the ratio R' / R, so pixels are refined where it
changes from sample to sample: at the rims of shadows, not inside them.
"""

from __future__ import annotations

import numpy as np
import pyopencl.array as cl_array
import pyopencl.cltypes as cl_types
from numpy.typing import NDArray

from protocol.frames import CameraModel
from server.objects.rasterize import VirtualSurface
from server.opencl.buffers import BufferDescription, DeviceBuffer, StageBuffers
from server.opencl.engine import Engine, float4
from server.opencl.transfer import fill_bytes
from server.shading.differential_rendering import RealShadow
from server.shading.traced_scene import TracedScene
from server.transfer.sample_grid import SampleGrid, grid_of, pixel_grid
from server.volume.raycast import Surface

LEAST_CHANGE = 1 / 8
"""A larger difference of R' / R between the 4 x 4 samples on two opposite sides is refined."""
MARGIN_PX = 2
"""Pixels around an edge that are refined: half the width of the upsampling filter, see upsample.clh."""
SHOWN_MARGIN_PX = 4
"""Pixels around visible real surface: the upsampling filter's width, and one more for partly covered pixels."""
_LEAST_LISTED = 1024


class _Buffers(StageBuffers):
    virtual_edges = BufferDescription(np.uint8)
    """[h, w] 1 where virtual surface ends, bends or steps."""
    edge_pixels = BufferDescription(np.int32)
    visible_pixels = BufferDescription(np.uint8)
    """[h, w] 0 where virtual surface hides the real one."""
    varying_cells = BufferDescription(np.uint8)
    """[rows + 1, cols + 1] 1 where the ratio changes from sample to sample."""
    varying_pixels = BufferDescription(np.int32)
    refined_occluded = BufferDescription(cl_types.float4)
    refined_ratio = BufferDescription(cl_types.float4)


def refine_virtual(engine: Engine, camera: CameraModel, virtual: VirtualSurface, scene: TracedScene) -> cl_array.Array:
    """[h, w] float4: radiance that occluders take from the virtual surface near its edges; w = 0 elsewhere."""
    occluded = _cleared(engine, camera, engine.buffers(_Buffers).refined_occluded)
    edges = engine.buffers(_Buffers).virtual_edges.array((camera.height, camera.width))
    kernel = engine.kernel("adaptive.cl", "mark_edges", **_defines(engine, scene.bands))
    size = (camera.width, camera.height)
    engine.launch(kernel, size, *size, virtual.position, virtual.normal, scene.volume.voxel_m, edges)
    near = grown(engine.download(edges) > 0, MARGIN_PX)
    listed, pixels = _list_pixels(engine.buffers(_Buffers).edge_pixels, near)
    engine.launch(
        engine.kernel("adaptive.cl", "refine_virtual", **_defines(engine, scene.bands)),
        (listed,),
        scene.parameters(engine, pixel_grid(camera), scene.rays.interleave),
        *scene.arguments(engine),
        listed,
        pixels,
        virtual.position,
        virtual.normal,
        virtual.object_index,
        occluded,
        steps=scene.rays.count,
    )
    return occluded


def refine_real(
    engine: Engine,
    camera: CameraModel,
    surface: Surface,
    scene: TracedScene,
    ratio: RealShadow,
    virtual: VirtualSurface | None = None,
    eye: NDArray[np.float64] | None = None,
) -> cl_array.Array:
    """[h, w] float4: R' / R of real surface (eq. 7.1) where it varies among the samples of `ratio`; w = 0 elsewhere.

    Real surface that `virtual` hides from `eye` ([3], volume space) is not refined, if both are given.
    """
    refined = _cleared(engine, camera, engine.buffers(_Buffers).refined_ratio)
    cells = varying_cells(engine, ratio, scene.bands)
    if not cells.any():
        return refined
    varying = pixels_of(cells, ratio.stride, camera.width, camera.height)
    if virtual is not None and eye is not None:
        varying &= grown(_shown(engine, camera, surface, virtual, eye), SHOWN_MARGIN_PX)
    listed, pixels = _list_pixels(engine.buffers(_Buffers).varying_pixels, varying)
    engine.launch(
        engine.kernel("adaptive.cl", "refine_real", **_defines(engine, scene.bands)),
        (listed,),
        scene.parameters(engine, grid_of(ratio, camera), scene.rays.interleave),
        *scene.real_arguments(engine),
        listed,
        pixels,
        surface.positions,
        surface.normals,
        ratio.shaded,
        refined,
        steps=scene.rays.count,
    )
    return refined


def _shown(
    engine: Engine, camera: CameraModel, surface: Surface, virtual: VirtualSurface, eye: NDArray[np.float64]
) -> NDArray[np.bool_]:
    """[h, w] pixels whose centre the virtual surface does not hide."""
    shown = engine.buffers(_Buffers).visible_pixels.array((camera.height, camera.width))
    size, kernel = (camera.width, camera.height), engine.kernel("adaptive.cl", "mark_shown", **_defines(engine, 2))
    engine.launch(kernel, size, *size, surface.positions, virtual.position, float4(*eye, 0), shown)
    return np.asarray(engine.download(shown) > 0)


def varying_cells(engine: Engine, ratio: SampleGrid, bands: int) -> NDArray[np.bool_]:
    """[rows + 1, cols + 1] cells around which `ratio` changes; the first cell lies before the first sample."""
    varying = engine.buffers(_Buffers).varying_cells.array((ratio.rows + 1, ratio.cols + 1))
    kernel = engine.kernel("adaptive.cl", "mark_varying", **_defines(engine, bands))
    size = (ratio.cols + 1, ratio.rows + 1)
    engine.launch(kernel, size, ratio.cols, ratio.rows, ratio.values, LEAST_CHANGE, varying)
    return np.asarray(engine.download(varying) > 0)


def pixels_of(cells: NDArray[np.bool_], stride: int, width: int, height: int) -> NDArray[np.bool_]:
    """[height, width] the pixels of `cells` [rows + 1, cols + 1]; the grid begins half a stride before the picture."""
    row, col = (
        np.minimum((np.arange(n) + stride - stride // 2) // stride, m - 1)
        for n, m in zip((height, width), cells.shape, strict=True)
    )
    return np.asarray(cells[row][:, col])


def grown(mask: NDArray[np.bool_], by: int) -> NDArray[np.bool_]:
    """[h, w] `mask` dilated by a square of `by` pixels to each side."""
    result = mask
    for axis in (0, 1):
        line = result
        for step in range(1, by + 1):
            ahead, behind = [slice(None)] * 2, [slice(None)] * 2
            ahead[axis], behind[axis] = slice(step, None), slice(None, -step)
            result = result.copy()
            result[tuple(ahead)] |= line[tuple(behind)]
            result[tuple(behind)] |= line[tuple(ahead)]
    return result


def _list_pixels(buffer: DeviceBuffer, mask: NDArray[np.bool_]) -> tuple[int, cl_array.Array]:
    """How many pixels a mask has, and their indices (y width + x) in a longer array, whose size seldom changes."""
    pixels = np.flatnonzero(mask).astype(np.int32)
    room = max(_LEAST_LISTED, 1 << len(pixels).bit_length())
    return len(pixels), buffer.upload(np.pad(pixels, (0, room - len(pixels))))


def _cleared(engine: Engine, camera: CameraModel, buffer: DeviceBuffer) -> cl_array.Array:
    array = buffer.array((camera.height, camera.width))
    fill_bytes(engine.queue, array, 0)
    return array


def _defines(engine: Engine, bands: int) -> dict[str, int]:
    return {"BANDS": bands, "LANES": engine.lanes}
