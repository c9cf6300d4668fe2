"""Rendering in image space: GR15 and GR15FAST (thesis 7.3). Kernels: depth_views.cl; include/view_visibility.clh.

Other presets trace rays through the volume. These look visibility up in depth pictures: of real surface in the
auxiliary views that light estimation uses (auxiliary_views.py), of each virtual object in views from all around it.
The thesis draws objects into the room's views, but an object of 20 cm covers only a few of their pixels. Here each
object has views of its own, in its own axes, drawn once; they move with it. Shading is the same as with rays.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import pyopencl.array as cl_array
import pyopencl.cltypes as cl_types
from numpy.typing import NDArray

from server.input.measure import intrinsics
from server.objects.rasterize import Placed
from server.objects.voxelize import DistanceGrid
from server.opencl.buffers import BufferDescription, KeyedBufferDescription, StageBuffers
from server.opencl.engine import Engine, KernelArgument, float4, float16, int4
from server.opencl.structs import VIEW_PARAMETERS
from server.transfer.real_depth_views import RealDepthViews

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class ViewShape:
    """Layout of the views of one object."""

    cells: int
    """Views along a side of the octahedral map of the upper half of directions."""
    px: int
    """Pixels of a view's side."""

    @property
    def texels(self) -> int:
        """Number of texels of one object."""
        return (self.cells * self.px) ** 2


FINE, COARSE = ViewShape(24, 32), ViewShape(12, 16)
"""Neighbouring views are about 7 and 15 degrees apart. An object needs 2.4 MB or 0.15 MB."""
MOST_FINE = 64
"""Scenes of more different meshes use COARSE views."""


class _Buffers(StageBuffers):
    view_of = BufferDescription(np.int32)
    """[directions] the auxiliary view that shows what a direction meets."""
    object_slots = BufferDescription(np.int32)
    """[objects] where each object's views begin."""
    view_axes = KeyedBufferDescription(cl_types.float4)
    """[cells^2, 3] for each number of cells: rows right, down and ahead of an object's views."""


@dataclass(frozen=True)
class DepthViews:
    """Depth pictures in which shading looks up visibility. The arrays are valid until the next frame."""

    real: RealDepthViews
    shape: ViewShape
    texels: cl_array.Array
    """[slot, cells^2, px, px] uint32: first and last surface along a pixel's line, see views.clh; 0 = none."""
    slots: cl_array.Array
    """[objects] int32."""

    def defines(self) -> dict[str, int]:
        """Shapes that kernels are compiled for."""
        return {"IMAGE_SPACE": 1, "VIEW_CELLS": self.shape.cells, "VIEW_PX": self.shape.px}

    def arguments(self, engine: Engine) -> tuple[KernelArgument, ...]:
        """VIEW_PARAMETERS of include/views.clh."""
        views = self.real.views
        parameters = VIEW_PARAMETERS(
            picture_from_volume=float16(self.real.camera_from_volume),
            picture_intrinsics=intrinsics(self.real.camera),
            center=float4(*views.center, 0.0),
            side=views.side,
            distance_m=views.distance_m,
            per_pixel=views.per_pixel,
            picture_width=self.real.camera.width,
            picture_height=self.real.camera.height,
            near_m=self.real.near_m,
            near_ratio=self.real.ratio,
            most_apart=self.real.threshold / 2,
        )
        return (
            parameters,
            engine.buffers(_Buffers).view_of.upload(self.real.view_of),
            views.axes,
            views.depths,
            self.real.depths,
            self.real.surface.positions,
            self.real.surface.normals,
            self.texels,
            self.slots,
        )


def draw_depth_views(engine: Engine, real: RealDepthViews, objects: Sequence[Placed]) -> DepthViews:
    """The views of one frame. Views of new objects are drawn."""
    views = engine.state(_ObjectViews)
    grids = [thing.grid for thing, _ in objects]
    slots = views.slots_of(engine, grids)
    assert views.texels is not None
    return DepthViews(real, views.shape, views.texels, engine.buffers(_Buffers).object_slots.upload(slots))


class _ObjectViews:
    """The views of the meshes in the scene, each in a slot of one array."""

    def __init__(self) -> None:
        self.shape = FINE
        self.texels: cl_array.Array | None = None
        self._grids: list[cl_array.Array | None] = []
        """The distance grid of each slot. A reference is kept so that no other grid gets its id."""

    def slots_of(self, engine: Engine, grids: Sequence[DistanceGrid]) -> NDArray[np.int32]:
        """The slot of each grid; new ones are drawn."""
        unique = {id(grid.distance): grid for grid in grids}
        shape = FINE if len(unique) <= MOST_FINE else COARSE
        if shape != self.shape:
            self.shape, self.texels, self._grids = shape, None, []
        slots = {id(array): slot for slot, array in enumerate(self._grids) if array is not None}
        new = [key for key in unique if key not in slots]
        if new or self.texels is None:
            gone = [slot for key, slot in slots.items() if key not in unique]
            for slot in gone:
                self._grids[slot] = None
            self._make_room(engine, len(unique))
            free = (slot for slot, array in enumerate(self._grids) if array is None)
            for key, slot in zip(new, free, strict=False):
                self._grids[slot], slots[key] = unique[key].distance, slot
                draw_object(engine, unique[key], shape, self.texels, slot)
        return np.array([slots[id(grid.distance)] for grid in grids], np.int32)

    def _make_room(self, engine: Engine, count: int) -> None:
        """Make at least `count` slots; drawn views are kept."""
        if self.texels is not None and len(self._grids) >= count:
            return
        room = max(count, 2 * len(self._grids))
        before, self.texels = self.texels, cl_array.empty(engine.queue, (room, self.shape.texels), np.uint32)
        if before is not None:
            engine.copy_into(self.texels, 0, before)
        self._grids += [None] * (room - len(self._grids))


def draw_object(engine: Engine, grid: DistanceGrid, shape: ViewShape, texels: cl_array.Array | None, slot: int) -> None:
    """Draw all views of an object, from its distance grid, into a slot of `texels` [slots, shape.texels]."""
    axes = np.zeros((shape.cells**2, 3, 4), np.float32)
    axes[..., :3] = view_axes(shape.cells)
    engine.launch(
        engine.kernel("depth_views.cl", "draw_object", LANES=1, VIEW_CELLS=shape.cells, VIEW_PX=shape.px),
        (shape.px, shape.px, shape.cells**2),
        int4(*grid.dims, 0),
        grid.distance,
        engine.buffers(_Buffers).view_axes[shape.cells].constant(axes.view(cl_types.float4)[..., 0]),
        slot,
        texels,
    )


def view_axes(cells: int) -> Floats:
    """[cells^2, 3, 3] rows right, down and ahead (z >= 0) of an object's views in the grid's axes, as in views.clh."""
    v, u = (np.mgrid[:cells, :cells].reshape(2, -1) + 0.5) * (2 / cells) - 1
    x, y = (u + v) / 2, (u - v) / 2
    ahead = np.stack([x, y, 1 - np.abs(x) - np.abs(y)], axis=-1)
    ahead /= np.linalg.norm(ahead, axis=-1, keepdims=True)
    x, y, z = ahead.T
    a, one = -1 / (1 + z), np.ones_like(x)
    b = x * y * a
    return np.stack(
        [np.stack([one + x * x * a, b, -x], axis=-1), np.stack([b, one + y * y * a, -y], axis=-1), ahead], axis=1
    )
