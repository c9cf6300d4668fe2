"""Observed indirect light: an occluded direction receives the radiance of the surface that occludes it.

Kernel: indirect.cl. Surfaces are assumed Lambertian, so the colour in the volume is their radiance in all directions.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pyopencl.array as cl_array
import pyopencl.cltypes as cl_types
from numpy.typing import NDArray

from protocol.frames import CameraModel
from server.opencl.buffers import BufferDescription, StageBuffers
from server.opencl.engine import Engine
from server.opencl.pending_read import PendingRead
from server.opencl.structs import GATHER_PARAMETERS
from server.transfer.radiance_transfer import Directions, Transfer, own_sets, sample_grid
from server.volume.raycast import Surface
from server.volume.volume import Volume

EVERY = 4
"""A sample traces every EVERY-th of its blocked directions; its neighbours trace the others."""
LEAST_COSINE = 0.05
"""Least cosine of a direction that is used, as in cell_transfer.cl."""


class _Buffers(StageBuffers):
    hits = BufferDescription(cl_types.float4)
    """[rows, cols] as gather_hits returns it."""
    met = BufferDescription(np.uint32)
    """[rows, cols, most] as gather_hits returns it."""
    no_hits = BufferDescription(cl_types.float4)
    """[rows, cols] zeros."""


@dataclass(frozen=True)
class Indirect:
    """Indirect light between the surfaces of one frame."""

    hits: cl_array.Array
    """[rows, cols] float4, see gather_hits."""
    mean: NDArray[np.float64]
    """[3] mean radiance of the surfaces that were met; used for surface that no picture shows."""
    met: cl_array.Array | None = None
    """[rows, cols, most] uint32: which directions met surface, and how far away (met.clh)."""


def observe_indirect(
    engine: Engine, transfer: Transfer, rays: Directions, hits: cl_array.Array, mean: MeanSent, *, is_kept: bool = False
) -> Indirect:
    """Indirect light at the samples of `transfer`, from the surfaces that block their directions: the `hits` of
    `gather_hits`, once all samples have theirs. `mean`: of the session. is_kept: frames to come are drawn with it."""
    return Indirect(hits, mean.update(engine, hits, waits=is_kept), room_for_met(engine, transfer, rays))


def gather_hits(
    engine: Engine,
    camera: CameraModel,
    volume: Volume,
    surface: Surface,
    transfer: Transfer,
    rays: Directions,
    ray_length_m: float,
    every: int = EVERY,
    found: cl_array.Array | None = None,
) -> cl_array.Array:
    """[rows, cols] float4: sums over a sample's blocked directions that meet surface with a colour: cosine times
    radiance (rgb) and cosine (w), both times `every`. The directions that met surface are in `room_for_met`.

    `found`: of transfer_cache.py; samples that were found there keep their values."""
    hits, met = room_for_hits(engine, transfer), room_for_met(engine, transfer, rays, every)
    words = transfer.free_mask.shape[2]
    defines = {"MASK_WORDS": words, "LANES": engine.lanes, "INTERLEAVE": transfer.interleave}
    if found is not None:
        defines["HAS_CACHE"] = 1
    engine.launch(
        engine.kernel("indirect.cl", "gather_hits", **defines),
        (transfer.cols, transfer.rows),
        GATHER_PARAMETERS(
            grid=sample_grid(camera, transfer),
            volume=volume.shape,
            count=rays.count,
            every=every,
            most=met.shape[2],
            ray_length_m=ray_length_m,
            least_cosine=LEAST_COSINE,
        ),
        surface.positions,
        surface.normals,
        transfer.free_mask,
        transfer.sets if transfer.sets is not None else own_sets(engine, transfer.rows, transfer.cols),
        *volume.arguments()[1:],
        volume.colors,
        rays.on_device(engine),
        hits,
        met,
        *(() if found is None else (found,)),
        steps=max(rays.count // every, 1),
    )
    return hits


def room_for_hits(engine: Engine, transfer: Transfer) -> cl_array.Array:
    """The array [rows, cols] float4 that `gather_hits` fills."""
    return engine.buffers(_Buffers).hits.array((transfer.rows, transfer.cols))


def room_for_met(engine: Engine, transfer: Transfer, rays: Directions, every: int = EVERY) -> cl_array.Array:
    """The array [rows, cols, most] uint32 that `gather_hits` fills beside, see Indirect.met."""
    return engine.buffers(_Buffers).met.array((transfer.rows, transfer.cols, -(-rays.count // every)))


def no_hits(engine: Engine, transfer: Transfer) -> cl_array.Array:
    """Zeros in place of gather_hits, where indirect light is left out."""
    return engine.buffers(_Buffers).no_hits.constant(np.zeros((transfer.rows, transfer.cols), cl_types.float4))


class MeanSent:
    """Mean radiance of all surfaces that rays meet: that of the last picture, so that no frame waits for its own."""

    def __init__(self) -> None:
        self._mean: NDArray[np.float64] = np.zeros(3)
        self._hits: PendingRead | None = None

    def update(self, engine: Engine, hits: cl_array.Array, *, waits: bool = False) -> NDArray[np.float64]:
        """[3] for the picture of `hits`; the first waits for its own mean, and others if they are told to. 0 before any
        surface was met."""
        last, self._hits = self._hits, engine.begin_download(hits)
        mean = mean_sent((self._hits if waits or last is None else last).result())
        if mean.any():  # where almost nothing is blocked, whether a surface is met is noise
            self._mean = mean
        return self._mean


def mean_sent(hits: NDArray[np.void]) -> NDArray[np.float64]:
    """[3] mean radiance of all surfaces in `hits` [rows, cols] float4; 0 without any."""
    total = hits.view(np.float32).reshape(-1, 4).sum(axis=0, dtype=np.float64)
    return np.asarray(total[:3] / total[3] if total[3] > 0 else np.zeros(3))
