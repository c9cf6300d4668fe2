"""Virtual geometry buffer (thesis 7.2, fig. 7.5): meshes drawn as position, normal and base colour.

Kernels: rasterize.cl. A pixel belongs to the nearest triangle that covers its centre; where two are equally near, to
the one with the lower number (objects in their order, triangles in the mesh's). The result does not depend on how work
is scheduled.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import accumulate, product

import numpy as np
import pyopencl.array as cl_array
import pyopencl.cltypes as cl_types
from numpy.typing import NDArray

from protocol.frames import CameraModel
from server.opencl.engine import Engine, float16, int4
from server.scene.virtual_object import VirtualObject

NEAR_M = 0.05
"""Nothing nearer to the camera's plane is drawn."""
_TILE = 8
_SCAN_ITEMS = 256
_LEAST_ENTRIES = 1 << 16
_LEAST_ROOM = 1 << 10

Matrix = NDArray[np.float64]
PixelBox = tuple[int, int, int, int]
Placed = tuple[VirtualObject, Matrix]


@dataclass(frozen=True)
class VirtualSurface:
    """What the virtual objects show to one camera; arrays of the engine's workspace, valid until the next call."""

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


@dataclass(frozen=True)
class _Pieces:
    """Device lists of one picture's clipped triangles."""

    corners: cl_array.Array
    inverse_depths: cl_array.Array
    starts: cl_array.Array
    entries: cl_array.Array


@dataclass(frozen=True)
class _Drawn:
    """An object in view: its number, and the number of its first triangle."""

    index: int
    first: int
    thing: VirtualObject
    volume_from_model: Matrix


def rasterize(
    engine: Engine, camera: CameraModel, camera_from_volume: Matrix, objects: Sequence[Placed]
) -> VirtualSurface:
    """Draw `objects`, each with its `volume_from_model`, as a pinhole camera sees them (its distortion is ignored).

    `camera_from_volume` [4, 4] float64, rigid: camera axes x right, y down, z forward. Waits for the device once.
    """
    camera_from_model = [camera_from_volume @ volume_from_model for _, volume_from_model in objects]
    pairs = list(zip(objects, camera_from_model, strict=True))
    boxes = tuple(pixel_box(camera, matrix, *thing.bounds) for (thing, _), matrix in pairs)
    in_view = [index for index, box in enumerate(boxes) if box is not None]
    firsts = accumulate((len(objects[index][0].triangles) for index in in_view), initial=0)
    drawn = [_Drawn(index, first, *objects[index]) for index, first in zip(in_view, firsts, strict=False)]
    pieces = _make_pieces(engine, camera, camera_from_volume, drawn)
    visible, object_index = _raster(engine, camera, pieces)
    position, normal, base_color = _shade(engine, camera, camera_from_volume, drawn, visible)
    return VirtualSurface(position, normal, base_color, object_index, boxes)


def pixel_box(
    camera: CameraModel, camera_from_model: Matrix, low: NDArray[np.float64], high: NDArray[np.float64]
) -> PixelBox | None:
    """Box of pixels that holds everything of the model box `low` to `high` that is in view; None if nothing is."""
    corners = np.array(list(product(*zip(low, high, strict=True))))
    corners = corners @ camera_from_model[:3, :3].T + camera_from_model[:3, 3]
    points = _in_front(corners)
    if not len(points):
        return None
    pixels = points[:, :2] / points[:, 2:] * (camera.fx, camera.fy) + (camera.cx, camera.cy)
    size = (camera.width, camera.height)
    x0, y0 = np.clip(np.floor(pixels.min(axis=0)), 0, size).astype(int).tolist()
    x1, y1 = np.clip(np.ceil(pixels.max(axis=0)) + 1, 0, size).astype(int).tolist()
    return (x0, y0, x1, y1) if x0 < x1 and y0 < y1 else None


def _in_front(corners: NDArray[np.float64]) -> NDArray[np.float64]:
    """Corners of a box [8, 3] beyond the near plane, and where its edges pass through it."""
    beyond = corners[:, 2] >= NEAR_M
    start, end = _BOX_EDGES.T
    crossing = beyond[start] != beyond[end]
    a, b = corners[start][crossing], corners[end][crossing]
    share = (NEAR_M - a[:, 2:]) / (b[:, 2:] - a[:, 2:])
    return np.concatenate([corners[beyond], a + share * (b - a)])


_BOX_EDGES = np.array([(i, i | bit) for i in range(8) for bit in (1, 2, 4) if not i & bit])
"""Pairs of corners that differ in one axis."""


def _pixel_from_camera(camera: CameraModel) -> Matrix:
    matrix = np.eye(4)
    matrix[:2, :3] = [[camera.fx, 0.0, camera.cx], [0.0, camera.fy, camera.cy]]
    return matrix


def _tiles(camera: CameraModel) -> int:
    return -(-camera.width // _TILE) * -(-camera.height // _TILE)


def _power_of_two(count: int) -> int:
    return 1 << max(count - 1, 0).bit_length()


def _make_pieces(engine: Engine, camera: CameraModel, camera_from_volume: Matrix, drawn: list[_Drawn]) -> _Pieces:
    """Project, clip and sort into tiles; what is too small is made larger, so nothing is lost."""
    space, tiles = engine.workspace, _tiles(camera)
    triangles = sum(len(item.thing.triangles) for item in drawn)
    starts = space.array("raster_starts", (tiles + 2,), np.int32)
    room, appended = 0, _LEAST_ROOM
    while appended > room:
        room = _power_of_two(appended)
        corners = space.array("raster_corners", (triangles + room,), cl_types.int8)
        inverse_depths = space.array("raster_inverse_depths", (triangles + room,), cl_types.float4)
        counts = _setup(engine, camera, camera_from_volume, drawn, corners, inverse_depths)
        scan = engine.kernel("rasterize.cl", "scan_tiles")
        engine.launch(scan, (_SCAN_ITEMS,), tiles, counts, starts, local=(_SCAN_ITEMS,))
        total, appended = (int(value) for value in engine.download(starts[tiles:]))
    entries = space.array("raster_entries", (_power_of_two(max(total, _LEAST_ENTRIES)),), np.int32)
    fill = engine.kernel("rasterize.cl", "fill_tiles")
    used = triangles + appended
    engine.launch(fill, (used,), used, camera.width, camera.height, corners, starts, counts, entries)
    return _Pieces(corners, inverse_depths, starts, entries)


def _setup(
    engine: Engine,
    camera: CameraModel,
    camera_from_volume: Matrix,
    drawn: list[_Drawn],
    corners: cl_array.Array,
    inverse_depths: cl_array.Array,
) -> cl_array.Array:
    """Fill `corners` and `inverse_depths` [pieces]; returns counts [1 + tiles]."""
    counts = engine.workspace.array("raster_counts", (1 + _tiles(camera),), np.int32)
    engine.launch(engine.kernel("rasterize.cl", "clear_counts"), counts.shape, counts.size, counts)
    triangles = sum(len(item.thing.triangles) for item in drawn)
    for item in drawn:
        pixel_from_model = _pixel_from_camera(camera) @ camera_from_volume @ item.volume_from_model
        count = len(item.thing.triangles)
        engine.launch(
            engine.kernel("rasterize.cl", "setup_triangles"),
            (count,),
            int4(count, item.first, triangles, len(corners) - triangles),
            int4(camera.width, camera.height, item.index, 0),
            item.thing.vertices,
            item.thing.triangles,
            float16(pixel_from_model),
            NEAR_M,
            counts,
            corners,
            inverse_depths,
        )
    return counts


def _raster(engine: Engine, camera: CameraModel, pieces: _Pieces) -> tuple[cl_array.Array, cl_array.Array]:
    """Number of the triangle and index of the object that each pixel shows, [h, w] int32, -1 where there is none."""
    shape = (camera.height, camera.width)
    visible = engine.workspace.array("raster_visible", shape, np.int32)
    object_index = engine.workspace.array("virtual_object_index", shape, np.int32)
    engine.launch(
        engine.kernel("rasterize.cl", "raster_tiles"),
        (_tiles(camera) * _TILE * _TILE,),
        camera.width,
        camera.height,
        pieces.corners,
        pieces.inverse_depths,
        pieces.starts,
        pieces.entries,
        visible,
        object_index,
        local=(_TILE * _TILE,),
    )
    return visible, object_index


def _shade(
    engine: Engine, camera: CameraModel, camera_from_volume: Matrix, drawn: list[_Drawn], visible: cl_array.Array
) -> tuple[cl_array.Array, cl_array.Array, cl_array.Array]:
    """Position, normal and base colour of each pixel's triangle, [h, w] float4."""
    space, shape = engine.workspace, visible.shape
    position = space.array("virtual_position", shape, cl_types.float4)
    normal = space.array("virtual_normal", shape, cl_types.float4)
    base_color = space.array("virtual_base_color", shape, cl_types.float4)
    clear = engine.kernel("rasterize.cl", "clear_uncovered")
    engine.launch(clear, (visible.size,), visible.size, visible, position, normal, base_color)
    for item in drawn:
        engine.launch(
            engine.kernel("rasterize.cl", "shade_surface"),
            (camera.width, camera.height),
            int4(camera.width, camera.height, item.first, len(item.thing.triangles)),
            visible,
            item.thing.vertices,
            item.thing.triangles,
            item.thing.attributes,
            float16(_model_from_pixel(camera, camera_from_volume @ item.volume_from_model)),
            float16(item.volume_from_model),
            position,
            normal,
            base_color,
        )
    return position, normal, base_color


def _model_from_pixel(camera: CameraModel, camera_from_model: Matrix) -> Matrix:
    """Columns 0 to 2 take (u, v, 1) to a ray's direction in model space, column 3 is the camera's place there; the last
    row takes a model point to its depth.
    """
    camera_from_pixel = np.linalg.inv(_pixel_from_camera(camera))
    camera_from_pixel[:3, 3] = 0.0
    matrix: Matrix = np.linalg.inv(camera_from_model) @ camera_from_pixel
    matrix[3] = camera_from_model[2]
    return matrix
