"""World-space cache of radiance transfer. Kernel: transfer_cache.cl.

Transfer and the light from surfaces belong to a place of the scanned surface, not to a frame. They are kept by cell
of the world. A cell is 1.4 to 2 times as long as the distance between samples, so a moving camera finds again what it
saw a frame, or a turn, ago. A sample that finds nothing is traced and stored. Surfaces in one cell that face two ways
have an entry each. An entry belongs to a point in the same cell. Surface that moves is no exception: what a point sees
of the scan depends on where it is only.

A cell is traced again when what it sees has changed. This is checked: every CHECKS-th frame in which an entry is found,
one of PARTS of its rays, and those whose surface is known, are traced from where they began. In the same volume they
end the same, to the bit. If an eighth of them are free that were blocked, or the other way, or of the known surface an
eighth lies elsewhere, the entry is too old. So a change that covers much of what a cell sees is noticed with the first
check, and any that covers an eighth of the rays of a part in CHECKS PARTS frames. Smaller ones, and what rays cannot
tell, as the colour of surface, are renewed after PERIOD frames.

A frame traces MOST_TRACED of its samples, in an order that covers the picture evenly: new ones first, each of them as
far as possible from those before it, then one of each cell that is too old. New ones that wait take the values of the
nearest sample on the same surface, three samples away at most; where there is none, they are traced as well. The next
frames find or trace them. Old ones that wait stand as they are, ORDERS frames at most. So a frame that turns to what
was never seen costs little more than others. A session's first one traces all (samples.py).

So an entry in view is off by what the scan has changed around it in CHECKS PARTS + ORDERS frames at most, by what is
small of PERIOD + ORDERS; one that comes into view again, by what has changed since it left it, until it is checked. How
far off that makes a picture is measured (kept_changes.py). Of a view that comes to rest, all samples are traced
(samples.py).

Transfer that is looked up in depth views (image_space.py) is kept likewise, with what the camera's picture adds near a
point when it is looked up. It has no rays to check, and is looked up again after PERIOD_OF_VIEWS frames. What of the
picture is not in the scan belongs to no place and is left out.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pyopencl.array as cl_array
import pyopencl.cltypes as cl_types
from numpy.typing import NDArray

from protocol.frames import CameraModel
from server.opencl.buffers import BufferDescription, StageBuffers
from server.opencl.engine import Engine, KernelArgument, float4
from server.opencl.pending_read import PendingRead
from server.opencl.structs import TRANSFER_CACHE_PARAMETERS
from server.transfer.indirect import room_for_hits, room_for_met
from server.transfer.radiance_transfer import (
    Cells,
    Directions,
    Transfer,
    room_for_mean_normals,
    sample_grid,
    traced_transfer,
)
from server.volume.raycast import Surface
from server.volume.volume import Volume

PERIOD = 64
"""Frames after which a cell is traced again in any case: two seconds at 30 frames/s, the time constant of the volume's
colours and distances (integrate.py)."""
PERIOD_OF_VIEWS = 32
"""The same for what was looked up in depth views, which are drawn anew one after the other."""
CHECKS = 16
"""Frames after which an entry is checked again: half a second."""
PARTS = 2
"""Of an entry's directions, of which each check traces one: the fewer, the longer a check and the surer to notice what
is small."""
ORDERS = 16
"""Frames that an old cell waits at most for its turn, as in transfer_cache.cl."""
MOST_TRACED = 1 / 8
"""Of a frame's samples, without those that must be: two of each block of 4 x 4, so that all of a new picture has values
from the beginning. A moving camera calls for a twentieth; with a thirtieth, pictures of the real kitchen differ by FLIP
.0003 more."""
PLACES_A_SAMPLE = 4
"""Size of the table, in samples of a frame, rounded up to a power of two. Views of the last seconds fit, and few cells
collide."""
MOST_BYTES = 1 << 28
"""Of the table. A place takes 240 bytes with the defaults, 512 with ART4's 324 directions."""
_WORDS_BESIDE = 20
"""Words of an entry besides mask, coefficients and directions that met surface, as in transfer_cache.cl."""
_UNCLAIMED = 0xFFFFFFFF


class _Buffers(StageBuffers):
    entries = BufferDescription(np.uint32)
    """[places, words]."""
    claims = BufferDescription(np.uint32)
    """[places] the sample that fills a place in this frame."""
    found = BufferDescription(np.int32)
    """[rows, cols] as find_samples returns it."""
    kept = BufferDescription(np.int32)
    """[rows, cols] as choose_samples and store_samples return it."""
    ways = BufferDescription(np.uint8)
    """[rows, cols] of Cells."""
    disc_parts = BufferDescription(cl_types.float4)
    disc_frames = BufferDescription(np.int32)
    """[places] of Cells."""


@dataclass(frozen=True)
class _Frame:
    """One frame's samples and what its kernels share."""

    volume: Volume
    surface: Surface
    transfer: Transfer
    rays: Directions
    is_traced: bool
    """By rays; else looked up in depth views."""
    hits: cl_array.Array
    met: cl_array.Array
    places: int
    """In the table."""
    words: int
    """Of an entry."""
    parameters: np.void
    defines: dict[str, int]


class TransferCache:
    """One session's. Call `find`, trace what is not kept, then `store`."""

    def __init__(self, engine: Engine) -> None:
        self._engine = engine
        self._buffers = engine.buffers(_Buffers)
        self._of: tuple[object, ...] = ()
        self._now = self._begun = 0
        self._frame: _Frame | None = None
        self._is_stored = True
        self._counts: PendingRead | None = None

    def forget(self) -> None:
        """Begin anew with the next frame: transfer is found in another way."""
        self._of = ()

    def find(
        self,
        camera: CameraModel,
        volume: Volume,
        surface: Surface,
        volume_from_camera: NDArray[np.float64],
        stride: int,
        rays: Directions,
        ray_length_m: float,
        *,
        is_traced: bool = True,
        with_hits: bool = True,
        traces_all: bool = False,
        renews: bool = False,
    ) -> cl_array.Array:
        """[rows, cols] int32: at least 0 where a sample is not traced. Its values are in the arrays that
        `transfer_radiance` and `gather_hits` return, which leave it out, or will be there after `store`.

        is_traced: by rays, which can be checked; else looked up in depth views. with_hits: `gather_hits` follows.
        traces_all: none that is new or too old waits; renews: nor is what is kept used. What was found otherwise, by
        other rays, in another volume or by another camera model is forgotten.
        """
        engine, transfer = self._engine, traced_transfer(self._engine, camera, stride, rays)
        hits, met = room_for_hits(engine, transfer), room_for_met(engine, transfer, rays)
        defines = {"BANDS": transfer.bands, "MASK_WORDS": transfer.free_mask.shape[2], "MOST_MET": met.shape[2]}
        if is_traced:
            defines |= {"IS_TRACED": 1, "LANES": engine.lanes}
        words = _WORDS_BESIDE + defines["MASK_WORDS"] + transfer.bands**2 + defines["MOST_MET"]
        samples = transfer.rows * transfer.cols
        places = places_for(samples, words)
        asked = (camera, stride, rays.count, rays.interleave, transfer.bands, ray_length_m, is_traced, with_hits)
        self._forget_others((volume, *asked), places, words)
        self._now += 1
        parameters = TRANSFER_CACHE_PARAMETERS(
            grid=sample_grid(camera, transfer),
            eye=float4(*volume_from_camera[:3, 3], 0.0),
            spacing=stride / camera.fx,
            now=self._now,
            renews=renews,
            period=PERIOD if is_traced else PERIOD_OF_VIEWS,
            checks=CHECKS if is_traced else 0,
            parts=PARTS,
            count=rays.count,
            met=met.shape[2] if with_hits else 0,
            ray_length_m=ray_length_m,
            places=places,
            most=samples if traces_all or renews else int(MOST_TRACED * samples),
        )
        self._frame = _Frame(volume, surface, transfer, rays, is_traced, hits, met, places, words, parameters, defines)
        buffers, size = self._buffers, (transfer.cols, transfer.rows)
        found, kept = (of.array((transfer.rows, transfer.cols)) for of in (buffers.found, buffers.kept))
        counts = engine.array_to_read((2 * ORDERS + 1,), np.int32)
        engine.fill(counts, 0)
        entries, claims = buffers.entries.array((places, words)), buffers.claims.array((places,))
        if not self._is_stored:  # the last frame was given up
            engine.fill(claims, _UNCLAIMED)
        self._is_stored = False
        engine.launch(
            engine.kernel("transfer_cache.cl", "find_samples", **defines),
            size,
            parameters,
            surface.positions,
            surface.normals,
            entries,
            transfer.coefficients,
            transfer.openness,
            transfer.flatness,
            transfer.free_mask,
            transfer.sets,
            hits,
            met,
            found,
            counts,
            claims,
        )
        engine.launch(
            engine.kernel("transfer_cache.cl", "choose_samples", **defines),
            size,
            parameters,
            surface.positions,
            surface.normals,
            entries,
            found,
            counts,
            claims,
            kept,
        )
        self._counts = engine.begin_download(counts)
        return kept

    @property
    def has_looked_again(self) -> bool:
        """Whether what it began with was checked or found anew since, so that changes have shown."""
        is_traced = self._frame is not None and self._frame.is_traced
        return self._now - self._begun > (CHECKS * PARTS if is_traced else PERIOD_OF_VIEWS) + ORDERS

    def store(self) -> Cells:
        """Keep what the samples that `find` left to be traced have now, and give it to those that wait beside them.
        Returns the cells of all samples."""
        engine, frame, buffers = self._engine, self._frame, self._buffers
        assert frame is not None
        transfer, surface, places = frame.transfer, frame.surface, frame.places
        entries, claims = buffers.entries.array((places, frame.words)), buffers.claims.array((places,))
        parts, frames = buffers.disc_parts.array((places,)), buffers.disc_frames.array((places,))
        kept, ways = (of.array((transfer.rows, transfer.cols)) for of in (buffers.kept, buffers.ways))
        to_check: tuple[KernelArgument, ...] = ()
        if frame.is_traced:
            to_check = (
                room_for_mean_normals(engine, transfer),
                *frame.volume.arguments()[:4],
                frame.rays.on_device(engine),
            )
        engine.launch(
            engine.kernel("transfer_cache.cl", "store_samples", **frame.defines),
            (transfer.cols, transfer.rows),
            frame.parameters,
            surface.positions,
            surface.normals,
            entries,
            transfer.coefficients,
            transfer.openness,
            transfer.flatness,
            transfer.free_mask,
            transfer.sets,
            frame.hits,
            frame.met,
            claims,
            frames,
            kept,
            ways,
            *to_check,
        )
        self._is_stored = True
        return Cells(kept, ways, claims, parts, frames, self._now)

    def share_waiting(self) -> float:
        """Of the last frame's samples, how many were new or too old and were not traced, 0 to 1."""
        if self._counts is None or self._frame is None:
            return 0.0
        transfer = self._frame.transfer
        return int(self._counts.result()[-1]) / (transfer.rows * transfer.cols)

    def _forget_others(self, asked: tuple[Volume, *tuple[object, ...]], places: int, words: int) -> None:
        """If what is asked for is other than before."""
        if self._of and self._of[0] is asked[0] and self._of[1:] == asked[1:]:
            return
        self._of, self._begun = asked, self._now
        engine, buffers = self._engine, self._buffers
        engine.fill(buffers.entries.array((places, words)), 0)
        engine.fill(buffers.claims.array((places,)), _UNCLAIMED)
        engine.fill(buffers.disc_frames.array((places,)), 0)
        buffers.disc_parts.array((places,))


def places_for(samples: int, words: int) -> int:
    """Places of the table for so many samples of a frame, of `words` 32-bit words each: a power of two."""
    most = max(MOST_BYTES // (4 * words), 1)
    return 1 << min((PLACES_A_SAMPLE * max(samples, 1) - 1).bit_length(), most.bit_length() - 1)
