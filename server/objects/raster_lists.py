"""Lists of one picture's triangles: large ones as pieces, sorted into tiles; small ones as fragments.

Kernels: rasterize.cl.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pyopencl as cl
import pyopencl.array as cl_array
import pyopencl.cltypes as cl_types

from server.objects.dirty_region import DirtyRegion, is_empty
from server.objects.pixel_boxes import NEAR_M, PixelBox
from server.objects.raster_tables import CHUNK, TILE, Picture, TableBuffers
from server.opencl.buffers import BufferDescription, BufferGroup, StageBuffers, Workspace
from server.opencl.engine import Engine, int2, int4
from server.opencl.pending_read import PendingRead

_SCAN_ITEMS = 256
_LEAST_ENTRIES = 1 << 16
_LEAST_ROOM = 1 << 10
_PIECES_PER_PIXEL = 4
"""Initial capacity, limited by the number of triangles; grows when needed."""
LIST_ITEMS = 1 << 14
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
class Lists:
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


def make_lists(
    engine: Engine, picture: Picture, buffers: RasterBuffers, nearest: cl_array.Array, cleared: PixelBox
) -> Lists:
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
    entries = _room_for_entries(engine, picture, buffers, starts)
    engine.launch(
        _kernel(engine, "fill_tiles"),
        (min(room, LIST_ITEMS),),
        min(room, LIST_ITEMS),
        tiles,
        len(entries),
        picture.size,
        corners,
        starts,
        counts,
        entries,
    )
    may_overflow = _FRAGMENTS_PER_TRIANGLE * picture.triangles > len(fragments)
    return Lists(projected, corners, inverse_depths, counts, starts, entries, nearest, fragments, may_overflow)


def _room_for_entries(
    engine: Engine, picture: Picture, buffers: RasterBuffers, starts: cl_array.Array
) -> cl_array.Array:
    """For the entries of `picture`, by what the last one listed where that tells."""
    last, ends = buffers.listed, engine.begin_download(starts[picture.tiles :])
    buffers.listed = _Listed(picture.covered, picture.triangles, ends)
    latest = last if last is not None and last.suffices(picture) else buffers.listed
    most = max(int(latest.ends.result()[0]), picture.triangles)
    wanted = min(max(_MORE_ENTRIES * most, _LEAST_ENTRIES), _MOST_ENTRIES)
    return buffers.entries.array((_power_of_two(wanted),))


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


def _kernel(engine: Engine, name: str) -> cl.Kernel:
    return engine.kernel("rasterize.cl", name)


def _power_of_two(count: int) -> int:
    return 1 << max(count - 1, 0).bit_length()
