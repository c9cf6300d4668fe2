"""Bounds of the change that virtual objects make to real surface in view, without tracing. Kernels: influence_bound.cl.

Each object is replaced by the ball around its box. A few samples are tested first: most often they already show that
the change is visible, and the rest is skipped. While the last frame's few samples showed it, a frame does not wait for
its own, which the next one reads: where the change fades, one more frame is drawn with all of it, and none with less.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import pyopencl.array as cl_array
import pyopencl.cltypes as cl_types
from numpy.typing import NDArray

from protocol.frames import CameraModel
from server.objects.rasterize import Placed
from server.opencl.buffers import BufferDescription, StageBuffers
from server.opencl.engine import Engine, float4
from server.opencl.pending_read import PendingRead
from server.shading.traced_scene import DeviceLight, ball_around, light_arguments
from server.transfer.indirect import Indirect, no_hits
from server.transfer.radiance_transfer import Directions, Transfer, sample_arguments, sample_grid
from server.transfer.sampling import Upsampling
from server.volume.raycast import Surface
from server.volume.volume import Volume

MOST_BALLS = 16
"""With more objects, one ball around all of them is used."""
WIDER = 1.05
"""Factor of the ball's radius: the distance grid that rays meet is up to one cell (1/60) larger than the mesh."""
EVERY = 4
"""Every so many samples along an axis are tested first."""
WINDOW = 16.0
"""Most samples in a pixel's mean: the pixel of a sample gets at least this part of its bound."""
_CHUNK = 16  # pixels of a work-item, as in influence_bound.cl
_ANYWHERE_RAD = 2.5 * np.pi
"""Half angle of a near disc, whose direction differs from point to point: no surface faces away from it (the sine is 1)
and nothing stands beside it (it is more than pi)."""

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class InfluenceBound:
    """Bounds for every pixel of real surface; infinite where they were not computed."""

    change: float
    """Bound on |R' / R - 1| (eq. 7.1) by light that objects block and send, without bounced light."""
    sent: float
    """Bound on the part of it by light that objects send."""
    bounced: float
    """Bound on the change by bounced light over the change of the surfaces that it bounces off."""


NOWHERE = InfluenceBound(0.0, 0.0, 0.0)
UNKNOWN = InfluenceBound(np.inf, np.inf, np.inf)


@dataclass
class FewSamples:
    """A session's."""

    last: PendingRead | None = None
    """Bounds at those of the last frame."""


@dataclass(frozen=True)
class MostSent:
    """Bounds on the radiance that leaves surfaces, [3] each, in the picture's units."""

    objects: Floats
    real: Floats


def bound_influence(
    engine: Engine,
    camera: CameraModel,
    surface: Surface,
    transfer: Transfer,
    volume: Volume,
    rays: Directions,
    ray_length_m: float,
    light: DeviceLight,
    indirect: Indirect | None,
    objects: Sequence[Placed],
    most: MostSent,
    seen_from: float,
    upsampling: Upsampling = "bilateral",
    few_samples: FewSamples | None = None,
) -> InfluenceBound:
    """Bounds for `objects`, of which there is at least one. seen_from: larger changes are visible anyway and are
    returned as infinite. Waits for the device, unless all of the change was visible at the last frame's `few_samples`.
    """
    balls = balls_around(objects)

    def at_samples(every: int, those: NDArray[np.float32]) -> cl_array.Array:
        return _bound_samples(
            engine, camera, surface, transfer, rays, ray_length_m, light, indirect, those, most, every
        )

    few_samples = few_samples or FewSamples()
    last, few_samples.last = few_samples.last, engine.begin_download(at_samples(EVERY, balls))
    for read in filter(None, (last, few_samples.last)):  # the second waits for the device
        few = _greatest(read.result())
        is_seen = few.change > WINDOW * seen_from
        if is_seen and few.bounced > seen_from:
            return UNKNOWN
    if is_seen:  # the rest needs no directions
        return replace(_greatest(engine.download(at_samples(1, balls[:0]))), change=np.inf)
    bounds = at_samples(1, balls)
    found = _greatest(engine.download(bounds))
    is_between = seen_from < found.change <= WINDOW * seen_from
    if not (is_between or light.discs):
        return found
    change, sent, _, is_dimmed = _bound_pixels(
        engine, camera, surface, transfer, volume, light, balls, bounds, is_between, upsampling
    )
    if is_between:
        found = InfluenceBound(float(change), float(sent), found.bounced)
    return replace(found, change=np.inf) if is_dimmed > 0 else found


class _Buffers(StageBuffers):
    balls = BufferDescription(cl_types.float4)
    """[n] of balls_around."""
    discs = BufferDescription(cl_types.float4)
    """[n] direction and half angle (rad) of each disc of the light."""


def balls_around(objects: Sequence[Placed]) -> NDArray[np.float32]:
    """[n] float4: centre (volume space) and radius in metres of balls around the objects as rays see them."""
    groups = [[item] for item in objects] if len(objects) <= MOST_BALLS else [objects]
    balls = np.array([ball_around(group).tolist() for group in groups], np.float32)
    balls[:, 3] *= WIDER
    return balls.view(cl_types.float4)[:, 0]


def _greatest(bounds: NDArray[np.void]) -> InfluenceBound:
    most = bounds.view(np.float32).reshape(-1, 4).max(axis=0, initial=0.0)
    return InfluenceBound(*(float(value) for value in most[:3]))


def _bound_samples(
    engine: Engine,
    camera: CameraModel,
    surface: Surface,
    transfer: Transfer,
    rays: Directions,
    ray_length_m: float,
    light: DeviceLight,
    indirect: Indirect | None,
    balls: NDArray[np.float32],
    most: MostSent,
    every: int,
) -> cl_array.Array:
    """[rows, cols] float4, see influence_bound.cl."""
    buffers = engine.buffers(_Buffers)
    cols, rows = -(-transfer.cols // every), -(-transfer.rows // every)
    bounds = engine.array_to_read((rows, cols), cl_types.float4)
    engine.launch(
        engine.kernel("influence_bound.cl", "bound_samples", **_defines(engine, light, transfer)),
        (cols, rows),
        sample_grid(camera, transfer),
        *sample_arguments(engine, surface, transfer),
        transfer.coefficients,
        indirect.hits if indirect else no_hits(engine, transfer),
        *light_arguments(engine, light, rays, ray_length_m),
        len(balls),
        buffers.balls.refresh(balls) if len(balls) else engine.unused,
        float4(*most.objects, 0.0),
        float4(*most.real, 0.0),
        every,
        cols,
        rows,
        bounds,
    )
    return bounds


def _bound_pixels(
    engine: Engine,
    camera: CameraModel,
    surface: Surface,
    transfer: Transfer,
    volume: Volume,
    light: DeviceLight,
    balls: NDArray[np.float32],
    bounds: cl_array.Array,
    has_bounds: bool,
    upsampling: Upsampling,
) -> NDArray[np.float32]:
    """[4] the greatest of all pixels, see influence_bound.cl."""
    buffers, chunks = engine.buffers(_Buffers), -(-camera.width // _CHUNK)
    table = np.array(
        [(*disc.direction, disc.half_angle_rad if disc.center_m is None else _ANYWHERE_RAD) for disc in light.discs]
        or [(0, 0, 1, 0)],
        np.float32,
    )
    most = engine.array_to_read((camera.height, chunks), cl_types.float4)
    defines = _defines(engine, light, transfer) | ({"BICUBIC": 1} if upsampling == "bicubic" else {})
    engine.launch(
        engine.kernel("influence_bound.cl", "bound_pixels", **defines),
        (chunks, camera.height),
        camera.height,
        surface.positions,
        surface.normals,
        sample_grid(camera, transfer),
        has_bounds,
        bounds,
        volume.voxel_m,
        len(light.discs),
        buffers.discs.refresh(table.view(cl_types.float4)[:, 0]),
        len(balls),
        buffers.balls.refresh(balls),
        most,
    )
    return np.asarray(engine.download(most).view(np.float32).reshape(-1, 4).max(axis=0, initial=0.0))


def _defines(engine: Engine, light: DeviceLight, transfer: Transfer) -> dict[str, int]:
    words = transfer.free_mask.shape[2]
    return {"BANDS": light.bands, "MASK_WORDS": words, "LANES": engine.lanes, "INTERLEAVE": transfer.interleave}
