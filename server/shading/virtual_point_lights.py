"""Virtual point lights: light that virtual objects reflect, one bounce, from a few points (thesis 7.3.3, eq. 7.3-7.7).

The points are distributed once over both sides of an object's surface. Every frame they are shaded as its pixels are.
A ray that meets the object takes the mean radiance of the points around that place. Kernels: differential_rendering.cl
(light_points), include/virtual_point_lights.clh.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import pyopencl.array as cl_array
import pyopencl.cltypes as cl_types
from numpy.typing import NDArray

from server.objects.rasterize import Placed
from server.objects.surface_points import SIDES, SurfacePoints, float4_rows
from server.opencl.buffers import BufferDescription, KeyedBufferDescription, StageBuffers
from server.opencl.engine import Engine
from server.opencl.parts import Parts

Floats = NDArray[np.float64]


class _Buffers(StageBuffers):
    points = BufferDescription(cl_types.float4)
    normals = BufferDescription(cl_types.float4)
    albedos = BufferDescription(cl_types.float4)
    offsets_m = BufferDescription(np.float32)
    table = BufferDescription(np.uint8)
    """VirtualPointLights.table."""
    unlit = BufferDescription(cl_types.float4)
    """[count] zeros."""
    empty_tables = KeyedBufferDescription(np.uint8)
    """VirtualPointLights.table for each number of objects that send nothing."""
    nothing_sent = BufferDescription(cl_types.float4)


@dataclass(frozen=True)
class VirtualPointLights:
    """What PointLights of virtual_point_lights.clh takes. The arrays are valid until the next frame."""

    table: Parts
    """`points`, `normals`, `cells` and `nearest`, in one buffer."""
    radiances: cl_array.Array


@dataclass(frozen=True)
class PlacedPoints:
    """The points of all objects, before they are lit."""

    count: int
    points: cl_array.Array
    """[count] float4: volume metres, w = 1."""
    normals: cl_array.Array
    """[count] float4: unit, volume axes."""
    colors: Floats
    """[count, 3] albedos on the host."""
    albedos: cl_array.Array
    """[count] float4."""
    offsets_m: cl_array.Array
    """[count] float32: distance from the surface at which a point's rays begin, metres."""
    point_lights: VirtualPointLights
    """The lights, which send nothing yet."""

    def under_even_light(self, radiance: Floats) -> NDArray[np.float32]:
        """[count] float4: what the points send under a radiance [3] that is the same from all directions."""
        return float4_rows(self.colors * radiance, 1.0)


def no_point_lights(engine: Engine, objects: int = 1) -> VirtualPointLights:
    """Point lights of objects that send nothing."""
    count, buffers = max(objects, 1), engine.buffers(_Buffers)
    empty = np.zeros(1, cl_types.float4)
    cells, nearest = np.zeros(count, cl_types.int4), np.full(SIDES, -1, np.int32)
    return VirtualPointLights(
        buffers.empty_tables[count].refresh_parts(
            {"points": empty, "normals": empty, "cells": cells, "nearest": nearest},
        ),
        buffers.nothing_sent.constant(empty),
    )


@dataclass(frozen=True)
class _Gathered:
    """The points of several objects, one object after the other, in each object's own space."""

    surfaces: tuple[SurfacePoints, ...]
    owners: NDArray[np.int64]
    """[n] index of the point's object."""
    points: Floats
    normals: Floats
    albedos: Floats
    nearest: NDArray[np.int32]
    """As in PointLights of virtual_point_lights.clh."""
    cells: NDArray[np.int32]
    """[objects, 4]."""


class _LastGathered:
    """The points of the last frame's objects: objects move often, but seldom change."""

    points: _Gathered | None = None


def _gather(engine: Engine, surfaces: tuple[SurfacePoints, ...]) -> _Gathered:
    last = engine.state(_LastGathered)
    if last.points is not None and [*map(id, last.points.surfaces)] == [*map(id, surfaces)]:
        return last.points
    counts, sizes = [len(s.points) for s in surfaces], [s.nearest[..., 0].size for s in surfaces]
    first, start = np.cumsum([0, *counts[:-1]]), np.cumsum([0, *sizes[:-1]])
    nearest = np.concatenate([s.nearest.ravel() for s in surfaces])
    shift = np.repeat(first, np.multiply(sizes, SIDES))
    last.points = _Gathered(
        surfaces,
        np.repeat(np.arange(len(surfaces)), counts),
        np.concatenate([s.points for s in surfaces]),
        np.concatenate([s.normals for s in surfaces]),
        np.concatenate([s.albedos for s in surfaces]),
        np.where(nearest >= 0, nearest + shift, -1).astype(np.int32),
        np.column_stack([[s.nearest.shape[2::-1] for s in surfaces], start]).astype(np.int32),
    )
    return last.points


def place_points(engine: Engine, objects: Sequence[Placed]) -> PlacedPoints:
    """The points of `objects`, each with its `volume_from_model`, in volume space."""
    buffers, every = engine.buffers(_Buffers), _gather(engine, tuple(thing.surface_points for thing, _ in objects))
    volume_from_model = np.array([matrix for _, matrix in objects])
    volume_from_grid = volume_from_model @ np.linalg.inv(np.array([thing.grid.grid_from_model for thing, _ in objects]))
    points = _turned(volume_from_grid[:, :3, :3], every.owners, every.points) + volume_from_grid[every.owners, :3, 3]
    normals = _turned(volume_from_model[:, :3, :3], every.owners, every.normals)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    cells_m = np.linalg.norm(volume_from_grid[:, :3, 0], axis=1)
    return PlacedPoints(
        len(points),
        buffers.points.refresh(float4_rows(points, 1.0)),
        buffers.normals.refresh(float4_rows(normals)),
        every.albedos,
        buffers.albedos.refresh(float4_rows(every.albedos)),
        buffers.offsets_m.refresh(cells_m[every.owners].astype(np.float32)),
        VirtualPointLights(
            buffers.table.refresh_parts(
                {
                    "points": float4_rows(every.points),
                    "normals": float4_rows(every.normals),
                    "cells": every.cells.view(cl_types.int4)[:, 0],
                    "nearest": every.nearest,
                },
            ),
            buffers.unlit.constant(np.zeros(len(points), cl_types.float4)),
        ),
    )


def _turned(matrices: Floats, owners: NDArray[np.int64], vectors: Floats) -> Floats:
    """[n, 3] each of `vectors` multiplied by its owner's matrix [objects, 3, 3]."""
    turned: Floats = np.einsum("nij,nj->ni", matrices[owners], vectors)
    return turned
