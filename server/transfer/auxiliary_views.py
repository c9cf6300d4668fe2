"""Depth views of the volume from all around it (thesis 7.3.2): surfaces outside of the camera's view cast shadows too.

Kernels: auxiliary_views.cl. The thesis uses four views (left, right, above, along the dominant light) and marches
through them. Here there are many more, so that each direction has a view nearly along it and needs only one look-up.
The views are small and the volume changes little between frames, so only some are redrawn in each frame. What has been
taken out of the volume since a view was drawn hides nothing any more: where a view shows surface, the volume is asked
whether it is still there. What has been put in hides light once the views are redrawn.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pyopencl as cl
import pyopencl.array as cl_array
import pyopencl.cltypes as cl_types
from numpy.typing import NDArray

from protocol.frames import CameraModel
from server.maths.sh import GOLDEN_TURN, spherical_fibonacci
from server.opencl.buffers import BufferDescription, StageBuffers
from server.opencl.engine import Engine, float4
from server.opencl.structs import GRID, LOOK_UP_PARAMETERS
from server.transfer.radiance_transfer import Directions, first_set
from server.volume.raycast import Surface
from server.volume.volume import BRICK, Volume

Floats = NDArray[np.float64]

SIDE_PX = 128
"""Pixels of a view's side."""
VIEWS = 1024
"""Views besides the one from the dominant light; neighbours are 6 degrees apart. Fewer: `Sampling.views`."""
DISTANCE = 50.0
"""From a view's eye to the volume's centre, in half diagonals: lines of sight are parallel to 1.2 degrees."""
_SET_STEP = 8  # samples so far apart along an axis have the same directions
_BLOCK_SIDE = 16  # of the samples of one set that a work-item of several lanes looks for; as in auxiliary_views.cl
LEAST_TURN = float(np.cos(np.deg2rad(3.0)))
"""The view from the dominant light is drawn anew once the light has turned by 3 degrees."""
GROWTH = 0.03
"""A view is redrawn when the number of the volume's bricks has grown by this share since it was drawn.

A camera that enters a room sees most of it within a second; light would leak through outdated views."""
YOUNG_FRAMES = 16
"""A view of a volume of fewer frames is redrawn when the number of frames has doubled: few noisy frames leave holes."""
YOUNG_ROUND = 8
"""Frames in which all views of a young volume are redrawn. In 43 the light of a noisy room's first 12 frames errs by 23
degrees in the mean instead of 6, with all in each frame by 5.6 (GR15FAST; `probeless tune`)."""
GROWTH_ROUND = 43
"""Frames in which all views are redrawn while the volume grows."""


@dataclass(frozen=True)
class AuxiliaryViews:
    """Views of the volume on the device. Points that a view does not see get no light from its direction."""

    toward: Floats
    """[views, 3] unit directions from the scene to the views' eyes, world axes; the last is towards the dominant light,
    if `has_light_view`."""
    has_light_view: bool
    axes: cl_array.Array
    """[views, 3] float4: right, down and forward of each view, unit, world axes."""
    depths: cl_array.Array
    """[views, side, side] float32 metres along the forward axis to the first solid voxel, 0 = none."""
    center: Floats
    """[3] volume space: the point that all views look at."""
    distance_m: float
    """Distance from every view's eye to the centre."""
    per_pixel: float
    """Slope between neighbouring lines of sight."""

    @property
    def side(self) -> int:
        """Pixels of a view's side."""
        return int(self.depths.shape[1])

    @property
    def pixel_m(self) -> float:
        """Size of a pixel at the scene's distance."""
        return self.per_pixel * self.distance_m


class _ViewBuffers(StageBuffers):
    axes = BufferDescription(cl_types.float4)
    """AuxiliaryViews.axes."""
    depths = BufferDescription(np.float32)
    """AuxiliaryViews.depths."""


class _Buffers(StageBuffers):
    due_views = BufferDescription(np.int32)
    """[n] indices of the views that a frame redraws."""
    view_of = BufferDescription(np.int32)
    """[SETS, count] index of the view for each direction."""
    lit = BufferDescription(np.uint32)
    """[rows, cols, words] as look_into_views returns it."""


class ViewsAround:
    """The views of one session and volume. Owned by one thread."""

    def __init__(self, engine: Engine, count: int = VIEWS, round_frames: int = 1) -> None:
        """`round_frames`: after the first frame, views are redrawn in turn, all of them in so many frames; in fewer
        while the volume grows."""
        self.lattice = spherical_fibonacci(count)
        self._engine, self._buffers = engine, _ViewBuffers(engine.workspace)
        scattered = np.argsort(np.arange(count) * GOLDEN_TURN % 1)
        self._order = np.append(scattered, count)  # views drawn together lie all around
        self._axes = np.zeros((count + 1, 3, 4), np.float32)
        self._axes[:count, :, :3] = view_axes(self.lattice)
        self._light = np.zeros(3)
        self._per_frame = -(-count // round_frames)
        self._next: int | None = None
        self._drawn_of = np.zeros((2, count + 1), np.int64)  # bricks and frames, by view

    def update(self, volume: Volume, dominant_direction: Floats | None = None) -> AuxiliaryViews:
        """Redraw views that are due and return all views. dominant_direction: world, unit, towards the light; None or
        zeros: not known."""
        if (
            dominant_direction is not None
            and dominant_direction @ self._light < LEAST_TURN
            and dominant_direction.any()
        ):
            self._light = np.array(dominant_direction, np.float64)
            self._axes[-1, :, :3] = view_axes(self._light)
            due = np.union1d(self._due(volume), len(self.lattice))
        else:
            due = self._due(volume)
        self._drawn_of[:, due] = [[volume.allocated_bricks], [volume.frames]]
        views = self._views(volume)
        draw_views(self._engine, volume, views, due.astype(np.int32))
        return views

    def _due(self, volume: Volume) -> NDArray[np.int64]:
        """Indices of the views to redraw in this frame, the light's view after the others, the oldest first."""
        count = len(self.lattice)
        if self._next is None:
            self._next = 0
            return np.arange(count)
        bricks, frames = self._drawn_of[:, :count]
        has_grown = volume.allocated_bricks > (1 + GROWTH) * bricks
        has_aged = (frames < YOUNG_FRAMES) & (volume.frames >= np.maximum(2 * frames, 1))
        of_growth = min(int(has_grown.sum()), max(-(-count // GROWTH_ROUND) - self._per_frame, 0))
        share = min(self._per_frame + max(of_growth, min(int(has_aged.sum()), -(-count // YOUNG_ROUND))), count)
        turns = (self._next + np.arange(share)) % (count + bool(self._light.any()))
        self._next = int(turns[-1]) + 1
        return self._order[turns]

    def _views(self, volume: Volume) -> AuxiliaryViews:
        size_m = np.array(volume.bricks) * (BRICK * volume.voxel_m)
        has_light = bool(self._light.any())
        toward = np.concatenate([self.lattice, self._light[None]]) if has_light else self.lattice
        return AuxiliaryViews(
            toward,
            has_light,
            self._buffers.axes.upload(self._axes.view(cl_types.float4)[..., 0]),
            self._buffers.depths.array((len(self._axes), SIDE_PX, SIDE_PX)),
            size_m / 2,
            DISTANCE * float(np.linalg.norm(size_m)) / 2,
            2 / (SIDE_PX * float(np.sqrt(DISTANCE**2 - 1))),
        )


def view_axes(toward: Floats) -> Floats:
    """[..., 3, 3] rows right, down and forward of views from unit directions `toward` [..., 3]."""
    forward = -toward
    helper = np.eye(3)[np.abs(forward).argmin(-1)]
    right = np.cross(helper, forward)
    right /= np.linalg.norm(right, axis=-1, keepdims=True)
    return np.stack([right, np.cross(forward, right), forward], axis=-2)


def draw_views(engine: Engine, volume: Volume, views: AuxiliaryViews, due: NDArray[np.int32]) -> None:
    """Cast the lines of sight of the views `due`."""
    engine.launch(
        _kernel(engine, "draw_views", views, 1),
        (-(-views.side // engine.lanes), views.side, len(due)),
        len(due),
        engine.buffers(_Buffers).due_views.upload(due),
        *volume.arguments(),
        float4(*views.center, 0.0),
        views.distance_m,
        views.per_pixel,
        views.axes,
        views.depths,
    )


def look_into_views(
    engine: Engine,
    camera: CameraModel,
    volume: Volume,
    surface: Surface,
    normals: cl_array.Array,
    stride: int,
    views: AuxiliaryViews,
    view_of: NDArray[np.int32],
    rays: Directions,
    ray_length_m: float,
    lift_m: float,
    turn: int,
) -> cl_array.Array:
    """[rows, cols, words] uint32: bit j set where direction j is above the surface of a sample and its view sees it.

    normals: [rows, cols] float4 of the samples, w = 0 where nothing is wanted and the result undefined. view_of:
    [SETS, count].
    """
    rows, cols = normals.shape
    words = -(-rays.count // 32)
    lit = engine.buffers(_Buffers).lit.array((rows, cols, words))
    side = _BLOCK_SIDE if engine.lanes == 8 else 1
    block_cols, block_rows = -(-cols // (_SET_STEP * side)), -(-rows // (_SET_STEP * side))
    engine.launch(
        _kernel(engine, "look_into_views", views, words),
        (_SET_STEP**2 * block_cols * block_rows,),
        LOOK_UP_PARAMETERS(
            grid=GRID(cols=cols, rows=rows, stride=stride, width=camera.width),
            center=float4(*views.center, 0.0),
            distance_m=views.distance_m,
            per_pixel=views.per_pixel,
            block_cols=block_cols,
            block_rows=block_rows,
            count=rays.count,
            first_set=first_set(turn),
            ray_length_m=ray_length_m,
            lift_m=lift_m,
        ),
        *volume.arguments(),
        surface.positions,
        normals,
        rays.on_device(engine),
        engine.buffers(_Buffers).view_of.upload(view_of),
        views.axes,
        views.depths,
        lit,
        local=(8,),
    )
    return lit


def _kernel(engine: Engine, name: str, views: AuxiliaryViews, words: int) -> cl.Kernel:
    return engine.kernel("auxiliary_views.cl", name, MASK_WORDS=words, LANES=engine.lanes, SIDE=views.side)
