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
from server.objects.dirty_region import DirtyRegion, is_empty
from server.objects.pinhole import Pinhole, finer
from server.objects.pixel_boxes import NEAR_M, PixelBox, pixel_boxes
from server.objects.raster_tables import CHUNK, TILE, Picture, TableBuffers, tabulate
from server.objects.virtual_object import VirtualObject
from server.opencl.buffers import BufferDescription, BufferGroup, StageBuffers, Workspace
from server.opencl.engine import Engine, int2, int4
from server.opencl.pending_read import PendingRead
from server.opencl.structs import SURFACE_PARAMETERS

__all__ = [
    "NEAR_M",
    "PixelBox",
    "Placed",
    "VirtualSurface",
    "boxes_in_view",
    "nearest_depths",
    "rasterize",
    "subpixels",
]

FINE_SUBPIXELS, COARSE_SUBPIXELS = 4, 2
"""Subpixels along each side of a pixel, for coverage. A nearly level or upright edge passes a row of them at once: it
has one shade more than that, and with three shades furniture has visible steps."""
FINE_PIXELS = 640 * 480
"""Pictures up to this size have fine subpixels. In larger ones steps are smaller, and the cost grows by the area."""
_SCAN_ITEMS = 256
_LEAST_ENTRIES = 1 << 16
_LEAST_ROOM = 1 << 10
_PIECES_PER_PIXEL = 4
"""Initial capacity, limited by the number of triangles; grows when needed."""
_LIST_ITEMS = 1 << 14
"""Work-items that go through a list whose length only the device knows."""
_MORE_TILES = 1.5
"""A picture that covers this many times as many tiles as the last one may have far more entries."""
_MORE_ENTRIES = 4
"""Room for so many times the entries of the last picture, or its triangles."""
_FRAGMENTS_PER_PIXEL = 2
"""Capacity; if there are more, the triangles are processed a second time."""
_FRAGMENTS_PER_TRIANGLE = 40
"""More fragments than a triangle in a square of 8 pixels can have."""
_MOST_ENTRIES = 1 << 27
"""Most entries of all tiles together: 512 MiB."""

Matrix = NDArray[np.float64]
Placed = tuple[VirtualObject, Matrix]


class RasterBuffers(StageBuffers):
    """Device buffers of one picture's tables and lists."""

    tables = BufferGroup(TableBuffers)
    projected = BufferDescription(cl_types.int4)
    """[vertices] on the screen."""
    starts = BufferDescription(np.int32)
    counts = BufferDescription(np.int32)
    """[tiles and a few] where each tile's entries begin, and how many it has."""
    corners = BufferDescription(cl_types.int8)
    inverse_depths = BufferDescription(cl_types.float4)
    """[pieces] of triangles."""
    entries = BufferDescription(np.int32)
    """[entries] pieces sorted by tile."""
    fragments = BufferDescription(cl_types.int4)
    """[fragments] of triangles smaller than a few pixels."""
    nearest = BufferDescription(np.uint32)
    """[h, w] bits of the nearest 1 / depth (1/metre)."""
    visible = BufferDescription(np.int32)
    """[h, w] index of the triangle that is seen."""

    def __init__(self, workspace: Workspace) -> None:
        super().__init__(workspace)
        self.drawn: DirtyRegion = DirtyRegion()
        """The region of `nearest`."""
        self.listed: _Listed | None = None
        """What the last picture listed."""


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
    fine_lists = BufferGroup(RasterBuffers)
    """Lists of nearest_depths."""


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
    """For each object x0, y0, x1, y1 (half-open, inside the picture) that holds all its pixels; None: not in view."""
    material: cl_array.Array | None = None
    """[h, w] float4: perceptual roughness, metalness, 0, w = 1; 0 where there is none; rasterize() always has it."""


@dataclass(frozen=True)
class _Listed:
    """How much one picture listed."""

    covered: int
    """Tiles of its region."""
    triangles: int
    ends: PendingRead
    """Entries, pieces and fragments."""

    def suffices(self, picture: Picture) -> bool:
        """Whether it says how many entries `picture` has at most. If it has more all the same, that only takes time."""
        return picture.covered <= _MORE_TILES * self.covered and picture.triangles <= self.triangles


@dataclass(frozen=True)
class _Lists:
    """Device lists of one picture's triangles: large ones as pieces, sorted into tiles; small ones as fragments."""

    projected: cl_array.Array
    corners: cl_array.Array
    inverse_depths: cl_array.Array
    counts: cl_array.Array
    starts: cl_array.Array
    entries: cl_array.Array
    nearest: cl_array.Array
    fragments: cl_array.Array
    may_overflow: bool
    """There may be more fragments than room for them."""


def rasterize(
    engine: Engine,
    camera: CameraModel,
    camera_from_volume: Matrix,
    objects: Sequence[Placed],
    buffers: VirtualSurfaceBuffers | None = None,
) -> VirtualSurface:
    """Draw `objects`, each with its `volume_from_model`, as a pinhole camera sees them (its distortion is ignored).

    `camera_from_volume` [4, 4] float64, rigid: camera axes x right, y down, z forward. buffers: of the result;
    None: the engine's. Waits for the device where there is much more to draw than the last time, or something to clip.
    """
    boxes = boxes_in_view(camera, camera_from_volume, objects)
    lists = engine.buffers(_Buffers).lists
    picture = tabulate(engine, camera, camera_from_volume, objects, boxes, lists.tables)
    _, visible = _draw(engine, picture, lists)
    buffers = buffers or engine.buffers(VirtualSurfaceBuffers)
    object_index, position, normal, base_color, material = _shade(engine, picture, visible, buffers)
    return VirtualSurface(position, normal, base_color, object_index, boxes, material)


def nearest_depths(
    engine: Engine, camera: CameraModel, camera_from_volume: Matrix, objects: Sequence[Placed]
) -> cl_array.Array:
    """[s h, s w] uint32: bits of 1 / depth (1/metre) of the nearest object at the centres of s x s subpixels a pixel;
    0 where there is none. s: of `subpixels`."""
    return drawn_depths(
        engine, finer(camera, subpixels(camera)), camera_from_volume, objects, engine.buffers(_Buffers).fine_lists
    )


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
    boxes = boxes_in_view(camera, camera_from_volume, objects)
    return _draw(engine, tabulate(engine, camera, camera_from_volume, objects, boxes, buffers.tables), buffers)[0]


def boxes_in_view(
    camera: CameraModel | Pinhole, camera_from_volume: Matrix, objects: Sequence[Placed]
) -> tuple[PixelBox | None, ...]:
    """For each object the bounds of its visible part in pixels, as in VirtualSurface."""
    matrices = np.array([matrix for _, matrix in objects], np.float64).reshape(-1, 4, 4)
    low, high = (np.array([thing.bounds[k] for thing, _ in objects], np.float64).reshape(-1, 3) for k in (0, 1))
    return pixel_boxes(camera, camera_from_volume @ matrices, low, high)


def _kernel(engine: Engine, name: str) -> cl.Kernel:
    return engine.kernel("rasterize.cl", name)


def _power_of_two(count: int) -> int:
    return 1 << max(count - 1, 0).bit_length()


def _draw(engine: Engine, picture: Picture, buffers: RasterBuffers) -> tuple[cl_array.Array, cl_array.Array]:
    """[h, w] bits of the nearest 1 / depth; [h, w] the triangle that has it, in the tiles of `picture.region` only."""
    nearest = buffers.nearest.array((picture.camera.height, picture.camera.width))
    with buffers.drawn.redraw(nearest, picture.region, picture.all_tiles) as tiles:
        lists = _make_lists(engine, picture, buffers, nearest, tiles)
        return nearest, _raster(engine, picture, lists, buffers)


def _make_lists(
    engine: Engine, picture: Picture, buffers: RasterBuffers, nearest: cl_array.Array, cleared: PixelBox
) -> _Lists:
    """Project, clip and sort the triangles. Buffers grow until everything fits. cleared: tiles of `nearest`."""
    tiles, shape = picture.tiles, (picture.camera.height, picture.camera.width)
    projected = buffers.projected.array((_power_of_two(max(picture.vertices, _LEAST_ROOM)),))
    starts = buffers.starts.array((tiles + 3,))
    counts = buffers.counts.array((2 + tiles,))
    pixels = shape[0] * shape[1]
    fragment_room = min(_FRAGMENTS_PER_TRIANGLE * picture.triangles, _FRAGMENTS_PER_PIXEL * pixels)
    fragments = buffers.fragments.array((_power_of_two(max(fragment_room, 1)),))
    room, pieces = 0, min(picture.triangles, _PIECES_PER_PIXEL * pixels) + _LEAST_ROOM
    while pieces > room:
        room = _power_of_two(pieces)
        corners = buffers.corners.array((room,))
        inverse_depths = buffers.inverse_depths.array((room,))
        _begin(engine, picture, counts, nearest, cleared, projected)
        _setup(engine, picture, projected, counts, corners, inverse_depths, nearest, fragments)
        scan = _kernel(engine, "scan_tiles")
        engine.launch(scan, (_SCAN_ITEMS,), tiles, _MOST_ENTRIES // tiles, counts, starts, local=(_SCAN_ITEMS,))
        if not (picture.is_whole and picture.triangles <= room):  # else a triangle has one piece at most
            pieces = int(engine.download(starts[tiles:])[1])
    last, buffers.listed = (
        buffers.listed,
        _Listed(picture.covered, picture.triangles, engine.begin_download(starts[tiles:])),
    )
    latest = last if last is not None and last.suffices(picture) else buffers.listed
    most = max(int(latest.ends.result()[0]), picture.triangles)
    entries = buffers.entries.array((_power_of_two(max(_MORE_ENTRIES * most, _LEAST_ENTRIES)),))
    engine.launch(
        _kernel(engine, "fill_tiles"),
        (min(room, _LIST_ITEMS),),
        min(room, _LIST_ITEMS),
        tiles,
        len(entries),
        picture.size,
        corners,
        starts,
        counts,
        entries,
    )
    may_overflow = _FRAGMENTS_PER_TRIANGLE * picture.triangles > len(fragments)
    return _Lists(projected, corners, inverse_depths, counts, starts, entries, nearest, fragments, may_overflow)


def _begin(
    engine: Engine,
    picture: Picture,
    counts: cl_array.Array,
    nearest: cl_array.Array,
    tiles: PixelBox,
    projected: cl_array.Array,
) -> None:
    """Clear counts and these tiles of `nearest`; find the vertices of the objects in view on the screen."""
    rows = 0 if is_empty(tiles) else (tiles[2] - tiles[0]) * (tiles[3] - tiles[1]) * TILE
    chunks = len(picture.vertex_chunks) if picture.vertices else 0
    engine.launch(
        _kernel(engine, "begin_picture"),
        (max(counts.size, rows, chunks * CHUNK),),
        picture.size,
        int4(*tiles),
        counts.size,
        chunks,
        picture.vertex_chunks,
        picture.objects,
        picture.matrices,
        NEAR_M,
        picture.arena.vertices,
        counts,
        nearest,
        projected,
        local=(CHUNK,),
    )


def _setup(
    engine: Engine,
    picture: Picture,
    projected: cl_array.Array,
    counts: cl_array.Array,
    corners: cl_array.Array,
    inverse_depths: cl_array.Array,
    nearest: cl_array.Array,
    fragments: cl_array.Array,
) -> None:
    """Fill the lists of pieces and fragments up to their capacity, and count all."""
    engine.launch(
        _kernel(engine, "setup_triangles"),
        (len(picture.triangle_chunks) * CHUNK if picture.triangles else 0,),
        picture.size,
        int2(len(corners), len(fragments)),
        picture.triangle_chunks,
        picture.objects,
        picture.matrices,
        NEAR_M,
        picture.arena.vertices,
        picture.arena.triangles,
        projected,
        counts,
        corners,
        inverse_depths,
        nearest,
        fragments,
        local=(CHUNK,),
    )


def _raster(engine: Engine, picture: Picture, lists: _Lists, buffers: RasterBuffers) -> cl_array.Array:
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
    items = min(room, _LIST_ITEMS)
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
    engine: Engine, picture: Picture, visible: cl_array.Array, buffers: VirtualSurfaceBuffers
) -> list[cl_array.Array]:
    """Index of each pixel's object [h, w] int32; position, normal, base colour and material, [h, w] float4."""
    arena, object_index = picture.arena, buffers.object_index.array(visible.shape)
    described = (buffers.position, buffers.normal, buffers.base_color, buffers.material)
    fields = [buffer.array(visible.shape) for buffer in described]
    with buffers.drawn.redraw(object_index, picture.region, picture.all_tiles) as tiles:
        x0, y0 = TILE * tiles[0], TILE * tiles[1]
        x1, y1 = min(TILE * tiles[2], picture.camera.width), min(TILE * tiles[3], picture.camera.height)
        engine.launch(
            _kernel(engine, "shade_surface"),
            (x1 - x0, y1 - y0),
            SURFACE_PARAMETERS(
                around=int4(x0, y0, x1, y1),
                region=int4(*picture.region),
                width=picture.camera.width,
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
            object_index,
            *fields,
        )
    return [object_index, *fields]
