"""Builds the object tables that rasterize.cl reads."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import pyopencl.array as cl_array
import pyopencl.cltypes as cl_types
from numpy.typing import NDArray

from protocol.frames import CameraModel
from server.objects.arena import Arena, gather
from server.objects.dirty_region import box_around
from server.objects.pinhole import Pinhole
from server.objects.pixel_boxes import PixelBox, are_whole
from server.objects.virtual_object import VirtualObject
from server.opencl.buffers import BufferDescription, StageBuffers
from server.opencl.engine import Engine, int2

TILE = 8
CHUNK = 128

Matrix = NDArray[np.float64]


class TableBuffers(StageBuffers):
    """Device buffers of one picture's tables, with the names of `Picture`."""

    objects = BufferDescription(cl_types.int8)
    matrices = BufferDescription(cl_types.float16)
    vertex_chunks = BufferDescription(cl_types.int2)
    triangle_chunks = BufferDescription(cl_types.int2)


@dataclass(frozen=True)
class Picture:
    """The objects as one camera sees them: the tables of rasterize.cl."""

    camera: CameraModel | Pinhole
    arena: Arena
    objects: cl_array.Array
    matrices: cl_array.Array
    vertex_chunks: cl_array.Array
    triangle_chunks: cl_array.Array
    count: int
    vertices: int
    triangles: int
    region: PixelBox
    """Tiles that the objects can cover: x0, y0, x1, y1, half-open; EMPTY where there are none."""
    is_whole: bool
    """No triangle has to be clipped."""

    @property
    def all_tiles(self) -> PixelBox:
        """As `region`, of the whole picture."""
        return 0, 0, -(-self.camera.width // TILE), -(-self.camera.height // TILE)

    @property
    def covered(self) -> int:
        """Number of tiles of `region`."""
        x0, y0, x1, y1 = self.region
        return (x1 - x0) * (y1 - y0)

    @property
    def size(self) -> np.generic:
        """Width and height of the picture."""
        return int2(self.camera.width, self.camera.height)

    @property
    def tiles(self) -> int:
        """Number of tiles of the picture."""
        return -(-self.camera.width // TILE) * -(-self.camera.height // TILE)


def tabulate(
    engine: Engine,
    camera: CameraModel | Pinhole,
    camera_from_volume: Matrix,
    objects: Sequence[tuple[VirtualObject, Matrix]],
    boxes: tuple[PixelBox | None, ...],
    buffers: TableBuffers,
) -> Picture:
    """The tables of `objects`, each with its `volume_from_model`; those without a box are not drawn."""
    things = [thing for thing, _ in objects]
    volume_from_model = np.array([matrix for _, matrix in objects], np.float64).reshape(-1, 4, 4)
    arena = gather(engine, things)
    slot = {id(thing): k for k, thing in enumerate(arena.things)}
    rows = np.zeros((max(len(things), 1), 8), np.int32)
    in_view = np.array([box is not None for box in boxes], bool)
    sizes = np.array([(len(t.vertices), len(t.triangles)) for t in things], np.int64).reshape(-1, 2) * in_view[:, None]
    before = np.cumsum(sizes, axis=0) - sizes
    low, high = (np.array([thing.bounds[k] for thing in things], np.float64).reshape(-1, 3) for k in (0, 1))
    if things:
        rows[:, :3] = arena.firsts[[slot[id(thing)] for thing in things]]
        rows[:, 3:5], rows[:, 5], rows[:, 6] = sizes, before[:, 1], before[:, 0]
    return Picture(
        camera,
        arena,
        buffers.objects.refresh(rows.view(cl_types.int8)[:, 0]),
        buffers.matrices.refresh(_matrices(camera, camera_from_volume, volume_from_model)),
        buffers.vertex_chunks.refresh(_chunks(sizes[:, 0])),
        buffers.triangle_chunks.refresh(_chunks(sizes[:, 1])),
        len(things),
        int(sizes[:, 0].sum()),
        int(sizes[:, 1].sum()),
        _tiles_of(box_around(boxes)),
        are_whole(camera, (camera_from_volume @ volume_from_model)[in_view], low[in_view], high[in_view]),
    )


def _tiles_of(box: PixelBox) -> PixelBox:
    return box[0] // TILE, box[1] // TILE, -(-box[2] // TILE), -(-box[3] // TILE)


def _matrices(
    camera: CameraModel | Pinhole, camera_from_volume: Matrix, volume_from_model: Matrix
) -> NDArray[np.float32]:
    """[3 n] float16: for each object pixel_from_model, model_from_pixel (see rasterize.cl) and volume_from_model."""
    pixel_from_camera = np.eye(4)
    pixel_from_camera[:2, :3] = [[camera.fx, 0.0, camera.cx], [0.0, camera.fy, camera.cy]]
    camera_from_pixel = np.linalg.inv(pixel_from_camera)
    camera_from_pixel[:3, 3] = 0.0
    camera_from_model = camera_from_volume @ volume_from_model
    model_from_pixel = np.linalg.inv(camera_from_model) @ camera_from_pixel
    model_from_pixel[:, 3] = camera_from_model[:, 2]  # not part of the ray: maps a model point to its depth
    matrices = np.stack([pixel_from_camera @ camera_from_model, model_from_pixel, volume_from_model], axis=1)
    rows = matrices.reshape(-1, 16).astype(np.float32)
    return (rows if len(rows) else np.zeros((1, 16), np.float32)).view(cl_types.float16)[:, 0]


def _chunks(sizes: NDArray[np.int64]) -> NDArray[np.int32]:
    """[n] int2: object and first item of each work-group, where the objects have `sizes` items."""
    groups = -(-sizes // CHUNK)
    index = np.repeat(np.arange(len(sizes)), groups)
    first = (np.arange(len(index)) - np.repeat(np.cumsum(groups) - groups, groups)) * CHUNK
    rows = np.stack([index, first], axis=1).astype(np.int32)
    return (rows if len(rows) else np.array([[0, 0]], np.int32)).view(cl_types.int2)[:, 0]
