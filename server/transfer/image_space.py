"""Radiance transfer in image space: GR15 and GR15FAST (thesis 6.2). Kernels: image_space.cl.

Visibility is looked up instead of traced. The far part of a direction is one look-up in the auxiliary view along it.
The near part, finer than their pixels, and moving objects that are not in the volume are found by marching through
the camera's geometry buffer. Sample distances grow by a constant ratio, so that each sample covers a part of the
direction's cone; the phase differs within blocks of 2 x 2 samples (6.2.1). 6.2.2 corrects self-occlusion.

Eq. 6.4 as printed, chi = cos(half the angle), lets V' rise over nearly 90 degrees, so that objects beside a direction
block it; 1 - cos, as in its text, is more accurate (tests/pipeline/test_image_space.py). The auxiliary views need no
correction: they look along the direction.
"""

from __future__ import annotations

import numpy as np
import pyopencl.array as cl_array
import pyopencl.cltypes as cl_types
from numpy.typing import NDArray

from protocol.frames import CameraModel
from server.input.measure import intrinsics
from server.maths.rigid import inverse_rigid
from server.maths.self_occlusion import occlusion_threshold
from server.maths.sh import GOLDEN_TURN
from server.opencl.buffers import BufferDescription, StageBuffers
from server.opencl.engine import Engine, KernelArgument, float16
from server.opencl.structs import VIEW_TRANSFER_PARAMETERS
from server.transfer.auxiliary_views import VIEWS, AuxiliaryViews, ViewsAround, look_into_views
from server.transfer.radiance_transfer import (
    Directions,
    Transfer,
    first_set,
    sample_grid,
    traced_transfer,
    window_arguments,
)
from server.transfer.real_depth_views import RealDepthViews
from server.volume.raycast import Surface
from server.volume.volume import Volume

Floats = NDArray[np.float64]

ROUND_FRAMES = 64
"""Frames in which all auxiliary views are redrawn: as long as places of the world keep their transfer at most
(transfer_cache.py). In the real kitchen rounds of 11 to 128 frames make pictures that differ by FLIP .0003."""
NEAR_STEPS = 4
"""Samples along a direction in the camera's picture."""
NEAR_PIXELS = 4.0
"""Length of the near part in pixels of the auxiliary views. In a longer one, surfaces beside a direction in the picture
darken more than they correct: at 38 cm the lights around the synthetic table are off by 14 degrees, at 10 cm by 3."""
FURTHER_STEPS = 8
"""Further samples where the volume does not contain what the picture shows (a hand); only that counts beyond the
near part."""
LEAST_RATIO = 1.3
"""Least ratio of the distances of neighbouring samples: 8 samples extend to 8 times the first distance."""
FIRST_VOXELS = 2.0
"""Distance of the first sample from the ray's origin, which lies one voxel off the surface, in voxels."""
SLACK = 0.15
"""Assumed thickness of a surface, as a share of a sample's distance: about the gap between two samples."""
LIFT_VOXELS = 1.5
"""Surface less than this many voxels above a point's tangent plane is the point's own surface."""


class _Buffers(StageBuffers):
    camera_depths = BufferDescription(np.float32)
    """[h, w] as camera_depths returns it."""
    any_unknown = BufferDescription(np.int32)
    """[1] 1 if the sensor alone knows the depth of a pixel."""
    sample_starts = BufferDescription(np.float32)
    """[4, rays] first distances of near_distances."""
    normals = BufferDescription(cl_types.float4)
    """[rows, cols] as smooth_normals returns it."""


class ImageSpaceTransfer:
    """One session's image-space transfer and its auxiliary views. Owned by one thread."""

    def __init__(self, engine: Engine, rays: Directions, views: int = VIEWS, round_frames: int = ROUND_FRAMES) -> None:
        """`round_frames`: in which all auxiliary views are redrawn."""
        self._engine = engine
        self._rays = rays
        self._around = ViewsAround(engine, views, round_frames)
        self._cosines, self._nearest = nearest_views(rays, self._around.lattice)
        self._threshold = occlusion_threshold(rays.directions[0, :, :3].astype(np.float64))
        self.depth_views: RealDepthViews | None = None

    def transfer(
        self,
        camera: CameraModel,
        volume_from_camera: Floats,
        volume: Volume,
        surface: Surface,
        stride: int,
        ray_length_m: float,
        dominant_direction: Floats | None = None,
        threshold: float | None = None,
        turn: int = 0,
        found: cl_array.Array | None = None,
    ) -> Transfer:
        """Transfer of the real world without virtual objects at every `stride`-th pixel, in arrays as
        `transfer_radiance` has.

        surface: the hybrid geometry buffer. dominant_direction: world, unit, towards the last estimated light, which
        gets a view of its own; None or zeros: not known. threshold: chi of eq. 6.3, None: 1 - cos of half the median
        angle. Beyond the near part, only the first surface that the light meets counts: if `ray_length_m` ends inside
        the scene, a nearer surface behind it may be missed. turn, found: as in `transfer_radiance`; what is found at
        places of the world is of the scan, so with `found` surface that only the sensor knows (a hand) blocks nothing.
        """
        views = self._around.update(volume, dominant_direction)
        view_of = self._views_for(views)
        near_m = near_reach_m(views, ray_length_m)
        self.depth_views = RealDepthViews(
            views,
            view_of,
            camera,
            inverse_rigid(volume_from_camera),
            surface,
            depth_room(self._engine, camera),
            near_m,
            near_distances(self._rays.count, volume.voxel_m, near_m)[1],
            threshold or self._threshold,
        )
        return transfer_from_views(
            self._engine,
            camera,
            volume_from_camera,
            volume,
            surface,
            views,
            view_of,
            stride,
            self._rays,
            ray_length_m,
            threshold or self._threshold,
            turn,
            found,
        )

    def _views_for(self, views: AuxiliaryViews) -> NDArray[np.int32]:
        """[SETS, count] the view whose axis is nearest to each direction."""
        if not views.has_light_view:
            return self._nearest
        to_light = self._rays.directions[..., :3] @ views.toward[-1].astype(np.float32)
        return np.where(to_light > self._cosines, len(views.toward) - 1, self._nearest).astype(np.int32)


def nearest_views(rays: Directions, toward: Floats) -> tuple[NDArray[np.float32], NDArray[np.int32]]:
    """For each direction [SETS, count] the nearest of the views from `toward` [views, 3]: cosine of the angle,
    index."""
    views = toward.T.astype(np.float32)
    cosines, nearest = np.empty(rays.directions.shape[:2], np.float32), np.empty(rays.directions.shape[:2], np.int32)
    for number, of_set in enumerate(rays.directions):  # all at once would take hundreds of megabytes
        of_views = of_set[:, :3] @ views
        cosines[number], nearest[number] = of_views.max(-1), of_views.argmax(-1)
    return cosines, nearest


def sample_phases(count: int) -> Floats:
    """[4, count] in [0, 1): where in its first step each direction's samples begin, for a pattern of 2 x 2 samples."""
    pattern = np.array([0.0, 0.5, 0.75, 0.25])
    phases: Floats = (pattern[:, None] + np.arange(count) * GOLDEN_TURN) % 1.0
    return phases


def near_distances(rays: int, voxel_m: float, near_m: float) -> tuple[NDArray[np.float32], float]:
    """First sample distances [4, rays] in metres, and the ratio between one and the next."""
    begin_m = FIRST_VOXELS * voxel_m
    ratio = max((near_m / begin_m) ** (1 / NEAR_STEPS), LEAST_RATIO)
    return (begin_m * ratio ** sample_phases(rays)).astype(np.float32), ratio


def near_reach_m(views: AuxiliaryViews, ray_length_m: float) -> float:
    """Length of the near part, which looks into the camera's own picture."""
    return min(NEAR_PIXELS * views.pixel_m, ray_length_m)


def depth_room(engine: Engine, camera: CameraModel) -> cl_array.Array:
    """The array [h, w] float32 that `camera_depths` fills."""
    return engine.buffers(_Buffers).camera_depths.array((camera.height, camera.width))


def camera_depths(
    engine: Engine, camera: CameraModel, volume_from_camera: Floats, surface: Surface, defines: dict[str, int]
) -> tuple[cl_array.Array, cl_array.Array]:
    """[h, w] float32 metres along the optical axis of the geometry buffer, 0 = no surface or one filled from its
    neighbours, negative where only the sensor knows it; [1] int32: 1 if there is such a pixel."""
    depths = depth_room(engine, camera)
    any_unknown = engine.buffers(_Buffers).any_unknown.array((1,))
    engine.fill(any_unknown, 0)
    engine.launch(
        engine.kernel("image_space.cl", "measure_depths", **defines),
        (camera.width, camera.height),
        camera.width,
        camera.height,
        surface.positions,
        surface.labels,
        float16(inverse_rigid(volume_from_camera)),
        depths,
        any_unknown,
    )
    return depths, any_unknown


def transfer_from_views(
    engine: Engine,
    camera: CameraModel,
    volume_from_camera: Floats,
    volume: Volume,
    surface: Surface,
    views: AuxiliaryViews,
    view_of: NDArray[np.int32],
    stride: int,
    rays: Directions,
    ray_length_m: float,
    threshold: float,
    turn: int = 0,
    found: cl_array.Array | None = None,
) -> Transfer:
    """As ImageSpaceTransfer.transfer, for given views. view_of [SETS, count]: the view for each direction."""
    result = traced_transfer(engine, camera, stride, rays)
    near_m = near_reach_m(views, ray_length_m)
    starts, ratio = near_distances(rays.count, volume.voxel_m, near_m)
    lift_m = LIFT_VOXELS * volume.voxel_m
    defines = {"BANDS": result.bands, "MASK_WORDS": result.free_mask.shape[2], "LANES": engine.lanes}
    depths, any_unknown = camera_depths(engine, camera, volume_from_camera, surface, defines)
    only: tuple[KernelArgument, ...] = ()
    if found is not None:
        defines["HAS_CACHE"] = 1
        only = (found,)
    normals = smooth_normals(engine, camera, surface, stride, volume.voxel_m, defines, only)
    engine.launch(
        engine.kernel("image_space.cl", "transfer_from_views", **defines),
        (result.cols, result.rows),
        VIEW_TRANSFER_PARAMETERS(
            grid=sample_grid(camera, result),
            camera_from_volume=float16(inverse_rigid(volume_from_camera)),
            intrinsics=intrinsics(camera),
            height=camera.height,
            voxel_m=volume.voxel_m,
            count=rays.count,
            first_set=first_set(turn),
            ratio=ratio,
            steps=NEAR_STEPS,
            further=FURTHER_STEPS if found is None else 0,
            near_m=near_m,
            ray_length_m=ray_length_m,
            slack=SLACK,
            inverse_threshold=1.0 / threshold,
        ),
        surface.positions,
        normals,
        look_into_views(
            engine, camera, volume, surface, normals, stride, views, view_of, rays, ray_length_m, lift_m, turn
        ),
        depths,
        rays.on_device(engine),
        rays.basis_on_device(engine),
        engine.buffers(_Buffers).sample_starts.upload(starts),
        any_unknown,
        result.coefficients,
        result.openness,
        result.flatness,
        result.free_mask,
        result.sets,
        *only,
    )
    return result


def smooth_normals(
    engine: Engine,
    camera: CameraModel,
    surface: Surface,
    stride: int,
    voxel_m: float,
    defines: dict[str, int],
    only: tuple[KernelArgument, ...] = (),
) -> cl_array.Array:
    """[rows, cols] float4: mean normals around the samples, volume space, w: flatness; 0 without surface.

    `only`: of transfer_cache.py, with HAS_CACHE; samples that were found there have 0 too.
    """
    cols, rows = camera.width // stride, camera.height // stride
    normals = engine.buffers(_Buffers).normals.array((rows, cols))
    engine.launch(
        engine.kernel("image_space.cl", "smooth_normals", **defines),
        (cols, rows),
        *window_arguments(camera, surface, stride),
        voxel_m,
        normals,
        *only,
    )
    return normals
