"""Virtual geometry buffer (thesis 7.2, fig. 7.5): meshes drawn as position, normal, base colour and material.

Kernels: rasterize.cl. A pixel shows the nearest triangle that covers its centre; of two equally near ones, the one with
the lower index (by object, then by triangle). The result does not depend on scheduling. All objects are drawn together:
the number of launches does not depend on the number of objects.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import pyopencl as cl
import pyopencl.array as cl_array
import pyopencl.cltypes as cl_types
from numpy.typing import NDArray

from protocol.frames import CameraModel
from server.objects.dirty_region import DirtyRegion
from server.objects.pinhole import Pinhole, finer
from server.objects.pixel_boxes import NEAR_M, PixelBox, pixel_boxes
from server.objects.raster_lists import LIST_ITEMS, Lists, RasterBuffers, make_lists
from server.objects.raster_tables import CHUNK, TILE, Picture, tabulate
from server.objects.virtual_object import VirtualObject
from server.opencl.buffers import BufferDescription, BufferGroup, StageBuffers, Workspace
from server.opencl.engine import Engine, int4
from server.opencl.structs import SURFACE_PARAMETERS

__all__ = [
    "NEAR_M",
    "PixelBox",
    "Placed",
    "VirtualSurface",
    "boxes_in_view",
    "rasterize",
    "subpixels",
]

FINE_SUBPIXELS, COARSE_SUBPIXELS = 4, 2
"""Subpixels along each side of a pixel, for coverage. A nearly level or upright edge passes a row of them at once: it
has two shades more than that, since those between two pixels count half for each."""
FINE_PIXELS = 640 * 480
"""Pictures up to this size have fine subpixels. In larger ones steps are smaller, and the cost grows by the area."""

Matrix = NDArray[np.float64]
Placed = tuple[VirtualObject, Matrix]


class VirtualSurfaceBuffers(StageBuffers):
    """Device buffers of a `VirtualSurface`, with its names."""

    position = BufferDescription(cl_types.float4)
    normal = BufferDescription(cl_types.float4)
    base_color = BufferDescription(cl_types.float4)
    material = BufferDescription(cl_types.float4)
    object_index = BufferDescription(np.int32)

    def __init__(self, workspace: Workspace) -> None:
        super().__init__(workspace)
        self.drawn: DirtyRegion = DirtyRegion()


class _Buffers(StageBuffers):
    lists = BufferGroup(RasterBuffers)


@dataclass(frozen=True)
class VirtualSurface:
    """The virtual objects as one camera sees them. The arrays are valid until the next call with the same buffers."""

    position: cl_array.Array
    """[h, w] float4: volume space metres (world axes, origin at the volume's), w = 1; all 0 where there is none."""
    normal: cl_array.Array
    """[h, w] float4: unit, volume axes, towards the camera, w = 1; all 0 where there is none."""
    base_color: cl_array.Array
    """[h, w] float4: linear RGB, w = 1; all 0 where there is none."""
    object_index: cl_array.Array
    """[h, w] int32: position in the sequence of objects, -1 where there is none."""
    boxes: tuple[PixelBox | None, ...]
    """For each object x0, y0, x1, y1 (half-open, inside the picture) that holds all pixels of which it covers a part;
    None: not in view."""
    material: cl_array.Array | None = None
    """[h, w] float4: perceptual roughness, metalness, 0, w = 1; 0 where there is none; rasterize() always has it."""
    nearest: cl_array.Array | None = None
    """[s h, s w] uint32: bits of 1 / depth (1/metre) of the nearest object at the centres of subpixels, s along either
    side of a pixel, 0 where there is none. Pixel (x, y) has its centre at subpixel (s x, s y). None where s is 1: a
    pixel is covered if its centre is."""


def rasterize(
    engine: Engine,
    camera: CameraModel,
    camera_from_volume: Matrix,
    objects: Sequence[Placed],
    buffers: VirtualSurfaceBuffers | None = None,
    parts: int = 1,
) -> VirtualSurface:
    """Draw `objects`, each with its `volume_from_model`, as a pinhole camera sees them (its distortion is ignored).

    `camera_from_volume` [4, 4] float64, rigid: camera axes x right, y down, z forward. buffers: of the result;
    None: the engine's. parts: subpixels along either side of a pixel. One picture is drawn, of subpixels; what a pixel
    shows is what is at its centre. Waits for the device where there is much more to draw than the last time, or
    something to clip.
    """
    lists, fine = engine.buffers(_Buffers).lists, finer(camera, parts)
    picture = _tabulated(engine, fine, camera_from_volume, objects, lists)
    nearest, visible = _draw(engine, picture, lists)
    buffers = buffers or engine.buffers(VirtualSurfaceBuffers)
    object_index, position, normal, base_color, material = _shade(engine, camera, picture, parts, visible, buffers)
    boxes = boxes_in_view(camera, camera_from_volume, objects)
    return VirtualSurface(position, normal, base_color, object_index, boxes, material, nearest if parts > 1 else None)


def subpixels(camera: CameraModel) -> int:
    """Subpixels along each side of a pixel of this camera."""
    return FINE_SUBPIXELS if camera.width * camera.height <= FINE_PIXELS else COARSE_SUBPIXELS


def drawn_depths(
    engine: Engine,
    camera: CameraModel | Pinhole,
    camera_from_volume: Matrix,
    objects: Sequence[Placed],
    buffers: RasterBuffers,
) -> cl_array.Array:
    """[h, w] uint32: bits of 1 / depth (1/metre) of the nearest object at the pixels' centres, 0 where there is none.

    The array is valid until the next call with the same `buffers`.
    """
    return _draw(engine, _tabulated(engine, camera, camera_from_volume, objects, buffers), buffers)[0]


def boxes_in_view(
    camera: CameraModel | Pinhole, camera_from_volume: Matrix, objects: Sequence[Placed]
) -> tuple[PixelBox | None, ...]:
    """For each object the bounds of its visible part in pixels, as in VirtualSurface."""
    matrices = np.array([matrix for _, matrix in objects], np.float64).reshape(-1, 4, 4)
    low, high = (np.array([thing.bounds[k] for thing, _ in objects], np.float64).reshape(-1, 3) for k in (0, 1))
    return pixel_boxes(camera, camera_from_volume @ matrices, low, high)


def _tabulated(
    engine: Engine,
    camera: CameraModel | Pinhole,
    camera_from_volume: Matrix,
    objects: Sequence[Placed],
    buffers: RasterBuffers,
) -> Picture:
    boxes = boxes_in_view(camera, camera_from_volume, objects)
    return tabulate(engine, camera, camera_from_volume, objects, boxes, buffers.tables)


def _kernel(engine: Engine, name: str) -> cl.Kernel:
    return engine.kernel("rasterize.cl", name)


def _draw(engine: Engine, picture: Picture, buffers: RasterBuffers) -> tuple[cl_array.Array, cl_array.Array]:
    """[h, w] bits of the nearest 1 / depth; [h, w] the triangle that has it, in the tiles of `picture.region` only."""
    nearest = buffers.nearest.array((picture.camera.height, picture.camera.width))
    with buffers.drawn.redraw(nearest, picture.region, picture.all_tiles) as tiles:
        lists = make_lists(engine, picture, buffers, nearest, tiles)
        return nearest, _raster(engine, picture, lists, buffers)


def _raster(engine: Engine, picture: Picture, lists: Lists, buffers: RasterBuffers) -> cl_array.Array:
    """Index of the triangle that each pixel shows, [h, w] int32, 2^31 - 1 without one; only in `region`."""
    x0, y0, x1, y1 = picture.region
    visible = buffers.visible.array(lists.nearest.shape)
    engine.launch(
        _kernel(engine, "raster_tiles"),
        ((x1 - x0) * (y1 - y0) * TILE * TILE,),
        picture.size,
        int4(*picture.region),
        picture.tiles,
        len(lists.entries),
        lists.corners,
        lists.inverse_depths,
        lists.starts,
        lists.entries,
        lists.nearest,
        visible,
        local=(TILE * TILE,),
    )
    room = len(lists.fragments)
    items = min(room, LIST_ITEMS)
    settle = _kernel(engine, "settle_fragments")
    engine.launch(settle, (items,), items, room, lists.counts, lists.fragments, lists.nearest, visible)
    if lists.may_overflow:
        engine.launch(
            _kernel(engine, "settle_triangles"),
            (len(picture.triangle_chunks) * CHUNK,),
            picture.size,
            room,
            lists.counts,
            picture.triangle_chunks,
            picture.objects,
            picture.arena.triangles,
            lists.projected,
            lists.nearest,
            visible,
            local=(CHUNK,),
        )
    return visible


def _shade(
    engine: Engine,
    camera: CameraModel,
    picture: Picture,
    parts: int,
    visible: cl_array.Array,
    buffers: VirtualSurfaceBuffers,
) -> list[cl_array.Array]:
    """Index of each pixel's object [h, w] int32; position, normal, base colour and material, [h, w] float4.

    picture, visible: of `parts` subpixels along either side of a pixel.
    """
    shape, arena = (camera.height, camera.width), picture.arena
    described = (buffers.object_index, buffers.position, buffers.normal, buffers.base_color, buffers.material)
    fields = [buffer.array(shape) for buffer in described]
    x0, y0, x1, y1 = (-(-TILE * side // parts) for side in picture.region)  # whose centres lie in the region
    drawn = (x0, y0, min(x1, camera.width), min(y1, camera.height))
    with buffers.drawn.redraw(fields[0], drawn, (0, 0, camera.width, camera.height)) as around:
        engine.launch(
            _kernel(engine, "shade_surface"),
            (around[2] - around[0], around[3] - around[1]),
            SURFACE_PARAMETERS(
                around=int4(*around),
                region=int4(*picture.region),
                width=camera.width,
                parts=parts,
                object_count=picture.count,
            ),
            visible,
            picture.objects,
            picture.matrices,
            arena.vertices,
            arena.triangles,
            arena.attributes,
            arena.material_of,
            arena.materials,
            arena.textures,
            arena.levels,
            arena.texels,
            arena.channel_values,
            *fields,
        )
    return fields
