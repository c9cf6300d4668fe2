"""Diffuse shadowed radiance transfer by ray tracing the volume (thesis 5.1.2, eq. 5.2).

Kernel: radiance_transfer.cl.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import numpy as np
import pyopencl.array as cl_array
import pyopencl.cltypes as cl_types
from numpy.typing import NDArray

from protocol.frames import CameraModel
from server.maths.sh import GOLDEN_TURN, sh_basis, spherical_fibonacci
from server.opencl.buffers import KeyedBufferDescription, StageBuffers
from server.opencl.engine import Engine, KernelArgument
from server.opencl.structs import GRID, TRANSFER_PARAMETERS
from server.transfer.visibility_cache import NO_CACHES, VisibilityCaches, no_caches
from server.transfer.visibility_state import VisibilityState
from server.volume.raycast import Surface
from server.volume.volume import Volume

SETS_A_FRAME = 64
"""Direction sets of one frame, interleaved over 8 x 8 samples, so that neighbours fill each other's gaps."""
TURNS = 4
"""Groups of direction sets that successive frames may cycle through. The error of the lattices then differs from frame
to frame, which improves a light estimated from several frames (tests/pipeline/test_presets.py)."""
SETS = TURNS * SETS_A_FRAME
"""Number of direction sets; fits a byte."""
_SEED = 1
_DEALT = 16
_WHOLE_TURNS = {1: 10, 2: 29, 4: 44, 8: 83}
"""Whole turns per advance, by the number of subsets k: chosen from 0 to 16 k so that subsets, sets and all sets
together are evenly spread."""
_WINDOW = 1 / 160  # half the window of a sample's mean normal, in picture widths


class _DirectionBuffers(StageBuffers):
    directions = KeyedBufferDescription(cl_types.float4)
    """[SETS, count] by interleave and count."""
    bases = KeyedBufferDescription(np.float32)
    """[SETS, count, bands^2] by interleave, count and bands^2."""


class TransferBuffers(StageBuffers):
    """Device buffers of transfers, for each number (rows, cols) of samples."""

    coefficients = KeyedBufferDescription(np.float32)
    openness = KeyedBufferDescription(np.float32)
    flatness = KeyedBufferDescription(np.float32)
    free_mask = KeyedBufferDescription(np.uint32)
    mean_normals = KeyedBufferDescription(cl_types.float4)
    sets = KeyedBufferDescription(np.uint8)
    own_sets = KeyedBufferDescription(np.uint8)
    """[rows, cols, 1] of own_sets, by turn, rows and columns."""
    chosen = KeyedBufferDescription(np.int32)
    """[rows cols] indices of the samples that are traced, repeated to fill the array."""


@dataclass(frozen=True)
class Directions:
    """Directions that visibility is tested along, with their basis functions."""

    directions: NDArray[np.float32]
    """[SETS, count, 4]: unit direction in world axes, solid angle in steradians."""
    basis: NDArray[np.float32]
    """[SETS, count, bands^2]."""
    interleave: int = 1
    """Subset i of a set is every `interleave`-th direction from i on; each is as evenly spread as a set of its size."""

    @property
    def count(self) -> int:
        """Directions in one set."""
        return int(self.directions.shape[1])

    def on_device(self, engine: Engine) -> cl_array.Array:
        """[SETS, count] float4: `directions`."""
        values = self.directions.view(cl_types.float4)
        return engine.buffers(_DirectionBuffers).directions[self.interleave, self.count].constant(values)

    def basis_on_device(self, engine: Engine) -> cl_array.Array:
        """[SETS, count, bands^2] float32: `basis`."""
        key = (self.interleave, self.count, self.basis.shape[2])
        return engine.buffers(_DirectionBuffers).bases[key].constant(self.basis)


@cache
def direction_sets(count: int, bands: int, interleave: int = 1) -> Directions:
    """SETS sets of `count` directions of equal solid angle. Four fine lattices a frame, each rotated at random, are
    each split into 16 sets, and each set into `interleave` subsets. Raises KeyError unless interleave is 1, 2, 4 or 8.

    A fine lattice advances by a sixteenth of (a golden turn plus whole turns), so that every sixteenth point advances
    by a golden turn: each set is a spherical Fibonacci lattice, and 16 of them together are a finer one. With k
    subsets, 16 k replaces 16. Since the error of a lattice is the same wherever it is used, blocks of samples use four
    different ones.
    """
    generator = np.random.default_rng(_SEED)
    advance = (GOLDEN_TURN + _WHOLE_TURNS[interleave]) / (_DEALT * interleave)
    lattice = spherical_fibonacci(_DEALT * count, advance)
    turns = [np.linalg.qr(generator.normal(size=(3, 3)))[0] for _ in range(SETS // _DEALT)]
    turned = np.stack([(lattice @ turn)[k::_DEALT] for turn in turns for k in range(_DEALT)])
    weighted = np.concatenate([turned, np.full((SETS, count, 1), 4 * np.pi / count)], -1)
    return Directions(weighted.astype(np.float32), sh_basis(turned, bands).astype(np.float32), interleave)


@dataclass(frozen=True)
class Cells:
    """The cells of the world that samples lie in (transfer_cache.py), and what else is kept there."""

    places: cl_array.Array
    """[rows, cols] int32: place of each sample's cell, -1 without one."""
    ways: cl_array.Array
    """[rows, cols] uint8: how it came to its transfer, see ways.clh."""
    claims: cl_array.Array
    """[cells] uint32: UINT_MAX but while a kernel decides which sample fills a cell."""
    disc_parts: cl_array.Array
    """[cells] float4: as of trace_discs in shadow_map.cl."""
    disc_frames: cl_array.Array
    """[cells] int32: frame in which they were traced; 0: never."""
    now: int
    """Number of this frame, from 1."""


@dataclass(frozen=True)
class Transfer:
    """Radiance transfer on the device; sample i along an axis lies at pixel stride / 2 + i stride."""

    stride: int
    rows: int
    cols: int
    bands: int
    coefficients: cl_array.Array
    """[rows, cols, bands^2] float32; zeros where there is no surface."""
    openness: cl_array.Array
    """[rows, cols] float32: free share of the cosine-weighted sky, -1 where there is no surface."""
    flatness: cl_array.Array
    """[rows, cols] float32: share of the window around a sample that lies on its own smooth surface."""
    free_mask: cl_array.Array
    """[rows, cols, words] uint32: bit j set where direction j is above the surface and free."""
    sets: cl_array.Array | None = None
    """[rows, cols, interleave] uint8: direction j is that of set sets[j % interleave]; None: all are of the sample's
    own set (direction_sets.clh)."""
    cells: Cells | None = None
    """None: nothing is kept from frame to frame."""

    @property
    def interleave(self) -> int:
        """Subsets of the directions."""
        return 1 if self.sets is None else int(self.sets.shape[2])


def transfer_radiance(
    engine: Engine,
    camera: CameraModel,
    volume: Volume,
    surface: Surface,
    stride: int,
    rays: Directions,
    ray_length_m: float,
    caches: VisibilityCaches | None = None,
    state: VisibilityState | None = None,
    turn: int = 0,
    chosen: NDArray[np.int32] | None = None,
    found: cl_array.Array | None = None,
) -> Transfer:
    """Transfer of the real world without virtual objects at every `stride`-th pixel, by rays of at most `ray_length_m`.

    `caches`: visibility from earlier frames, of the subsets of `rays` that this frame does not trace; this frame's is
    added. Without them all subsets are traced.
    `state`: voxels that are known to be open, where no ray is traced. `turn`: selects the direction sets, modulo TURNS.
    `chosen` [k]: only these samples (row * cols + col) are traced; the others keep their values.
    `found`: of transfer_cache.py; samples that were found there keep their values.
    """
    cols, rows = camera.width // stride, camera.height // stride
    subsets = rays.interleave if caches else 1
    buffers, result = engine.buffers(TransferBuffers), traced_transfer(engine, camera, stride, rays, subsets)
    words = result.free_mask.shape[2]
    defines = {"BANDS": result.bands, "MASK_WORDS": words, "LANES": engine.lanes, "INTERLEAVE": subsets}
    if state is not None:
        defines["HAS_STATE"] = 1
    only: tuple[KernelArgument, ...] = (state.bits,) if state else ()
    if chosen is not None:
        defines["IS_CHOSEN"] = 1
        only = (*only, buffers.chosen[rows, cols].upload(np.resize(chosen, rows * cols)))
    if found is not None:
        defines["HAS_CACHE"] = 1
        only = (*only, found, room_for_mean_normals(engine, result))
    engine.launch(
        engine.kernel("radiance_transfer.cl", "transfer_radiance", **defines),
        (cols, rows) if chosen is None else (len(chosen),),
        TRANSFER_PARAMETERS(
            grid=sample_grid(camera, result),
            volume=volume.shape,
            height=camera.height,
            radius=window_px(camera),
            count=rays.count,
            first_set=first_set(turn),
            ray_length_m=ray_length_m,
            chosen_count=0 if chosen is None else len(chosen),
            **(caches.parameters() if caches else NO_CACHES),
        ),
        surface.positions,
        surface.normals,
        surface.labels,
        *volume.arguments()[1:4],
        rays.on_device(engine),
        rays.basis_on_device(engine),
        *(caches.buffers() if caches else no_caches(engine)),
        result.coefficients,
        result.openness,
        result.flatness,
        result.free_mask,
        result.sets,
        *only,
        steps=rays.count,
    )
    return result


def traced_transfer(engine: Engine, camera: CameraModel, stride: int, rays: Directions, subsets: int = 1) -> Transfer:
    """What `transfer_radiance` returns, before it has run. `subsets`: that each have a direction set of their own."""
    cols, rows = camera.width // stride, camera.height // stride
    sets = engine.buffers(TransferBuffers).sets[rows, cols].array((rows, cols, subsets))
    return room_for_transfer(engine, rows, cols, stride, rays, sets)


def room_for_transfer(
    engine: Engine, rows: int, cols: int, stride: int, rays: Directions, sets: cl_array.Array
) -> Transfer:
    """The arrays of a transfer, with undefined contents; one set of arrays for each number of samples."""
    buffers, coefficients, size = engine.buffers(TransferBuffers), rays.basis.shape[2], (rows, cols)
    return Transfer(
        stride,
        rows,
        cols,
        round(coefficients**0.5),
        buffers.coefficients[size].array((rows, cols, coefficients)),
        buffers.openness[size].array(size),
        buffers.flatness[size].array(size),
        buffers.free_mask[size].array((rows, cols, -(-rays.count // 32))),
        sets,
    )


def room_for_mean_normals(engine: Engine, transfer: Transfer) -> cl_array.Array:
    """The array [rows, cols] float4 that `transfer_radiance` fills at the samples that are not found: the mean normal
    that rays rise from, and the flatness."""
    size = (transfer.rows, transfer.cols)
    return engine.buffers(TransferBuffers).mean_normals[size].array(size)


def window_arguments(camera: CameraModel, surface: Surface, stride: int) -> tuple[KernelArgument, ...]:
    """Kernel arguments: where samples lie, and the window of their mean normals (smooth_normal.clh)."""
    cols, rows = camera.width // stride, camera.height // stride
    return cols, rows, stride, camera.width, camera.height, window_px(camera), surface.positions, surface.normals


def window_px(camera: CameraModel) -> int:
    """Half the side of the window of a mean normal, pixels."""
    return max(1, round(camera.width * _WINDOW))


def first_set(turn: int) -> int:
    """Index of the first direction set of a frame with this turn."""
    return SETS_A_FRAME * (turn % TURNS)


def own_sets(engine: Engine, rows: int, cols: int, turn: int = 0) -> cl_array.Array:
    """[rows, cols, 1] uint8: each sample's direction set if no other frames contribute (direction_sets.clh)."""
    kept = engine.buffers(TransferBuffers).own_sets[turn % TURNS, rows, cols]
    return kept.constant(_sets_of(rows, cols, turn % TURNS))


def sample_grid(camera: CameraModel, transfer: Transfer) -> np.void:
    """GRID of the transfer's samples."""
    return GRID(cols=transfer.cols, rows=transfer.rows, stride=transfer.stride, width=camera.width)


def sample_arguments(engine: Engine, surface: Surface, transfer: Transfer) -> tuple[KernelArgument, ...]:
    """SAMPLE_BUFFERS of real_shading.clh: the samples of real surface, and which of their directions are free."""
    return (
        surface.positions,
        surface.normals,
        transfer.openness,
        transfer.free_mask,
        transfer.sets if transfer.sets is not None else own_sets(engine, transfer.rows, transfer.cols),
    )


@cache
def _sets_of(rows: int, cols: int, turn: int) -> NDArray[np.uint8]:
    row, col = np.mgrid[:rows, :cols]
    sets = first_set(turn) + ((row // 4 % 2) * 2 + col // 4 % 2) * _DEALT + row % 4 * 4 + col % 4
    return np.asarray(sets[..., None], np.uint8)
