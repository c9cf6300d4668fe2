"""Transfer to cells of the sphere and the normal equations of their radiances. Kernel: cell_transfer.cl.

Cells resolve the direction of light as finely as shadows do, unlike a few spherical harmonics. Samples are averaged
over neighbours with the same surface and colour, each traced along other directions, since least squares would fit the
remaining error of the transfer as signal.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from functools import cache

import numpy as np
import pyopencl as cl
import pyopencl.array as cl_array
import pyopencl.cltypes as cl_types
from numpy.typing import NDArray

from protocol.frames import CameraModel
from server.light.continuation import PlaneArrays, plane_arguments, spokes
from server.maths.lobes import CELL_SR, CELLS, CellEquations, cell_directions
from server.opencl.engine import Engine, float4
from server.transfer.indirect import Indirect
from server.transfer.radiance_transfer import Directions, Transfer, own_sets
from server.volume.raycast import Surface

POOL_PX = 8
"""Pixels between pools, at least; at least two samples too."""
MOST_POOLS = 1300
"""Of a frame; about as many as a picture of 320 x 240 has."""
_COLUMNS = CELLS + 8
_BLOCKS = _COLUMNS // 8
_CHUNKS = 8
_HALF_CELL = float(np.sqrt(CELL_SR / np.pi))

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class PoolGrid:
    """Division of an image into pools of samples."""

    step: int
    """Samples between pools."""
    rows: int
    cols: int

    @property
    def count(self) -> int:
        """Pools of a frame."""
        return self.rows * self.cols


@dataclass(frozen=True)
class Pools:
    """One frame's pools on the host; their transfer stays on the device."""

    grid: PoolGrid
    seen: Floats
    """[n, 3] radiance."""
    sent: Floats
    """[n, 3] what surfaces send white surface there; 0 where indirect light is left out."""
    unseen: Floats
    """[n] share of the cosine-weighted sky that is surface no picture shows."""
    weights: Floats
    """[n] share of the samples used, 0 where there is no pool."""
    positions: Floats
    """[n, 3] of the pools' middles, metres, volume space."""
    normals: Floats
    """[n, 3]."""
    open: Floats
    """[n] share of the cosine-weighted sky that nothing hides."""
    beyond: Floats
    """[3] radiance that is put in place of surface no picture shows."""


def pool_grid(transfer: Transfer) -> PoolGrid:
    """Pools of all samples."""
    step = max(2, -(-POOL_PX // transfer.stride))
    step = max(step, int(np.ceil(np.sqrt(transfer.rows * transfer.cols / MOST_POOLS))))
    return PoolGrid(step, -(-transfer.rows // step), -(-transfer.cols // step))


@cache
def cells_of(directions_bytes: bytes, count: int) -> NDArray[np.uint8]:
    """[SETS, count] the cell that each direction (float32 [SETS, count, 4]) lies in."""
    directions = np.frombuffer(directions_bytes, np.float32).reshape(-1, count, 4)[..., :3]
    nearest: NDArray[np.int64] = (directions @ cell_directions().T.astype(np.float32)).argmax(axis=-1)
    return nearest.astype(np.uint8)


class PoolWindow:
    """Transfer of the pools of recent frames on the device, one slot per frame. Frames may be from several cameras."""

    def __init__(self, engine: Engine, capacity: int, slots: int) -> None:
        """`capacity`: pools that a frame may have."""
        self._engine = engine
        self.capacity = capacity
        self.slots = slots
        shape = (slots, capacity, CELLS)
        self.raw: cl_array.Array = engine.workspace.array("pools_raw", shape, np.float32)
        """[slots, n, CELLS] transfer of white surface to each cell, as the volume has it."""
        self.values: cl_array.Array = engine.workspace.array("pools", shape, np.float32)
        """The same with planes continued (continuation.py)."""
        self._places = engine.workspace.array("pools_places", (slots, capacity, 8), np.float32)

    def pool(
        self,
        slot: int,
        grid: PoolGrid,
        surface: Surface,
        camera: CameraModel,
        transfer: Transfer,
        rays: Directions,
        observed: cl_array.Array,
        indirect: Indirect,
        voxel_m: float,
    ) -> Pools:
        """Pool a frame's usable samples into `slot`. Raises ValueError where the grid exceeds the capacity.

        observed: [rows, cols] float4 of the samples, w = 1 usable.
        """
        engine, space = self._engine, self._engine.workspace
        if grid.count > self.capacity:
            raise ValueError(f"a frame of {grid.count} pools does not fit a window for {self.capacity}")
        sets = own_sets(engine, transfer.rows, transfer.cols) if transfer.sets is None else transfer.sets
        centers = np.pad(cell_directions(), ((0, 0), (0, 1))).astype(np.float32)
        seen = space.array("pools_seen", (grid.count, 8), np.float32)
        engine.launch(
            self._kernel("pool_cells", MASK_WORDS=transfer.free_mask.shape[2], INTERLEAVE=transfer.interleave),
            (grid.cols, grid.rows),
            grid.cols,
            grid.rows,
            transfer.cols,
            transfer.rows,
            grid.step,
            transfer.stride,
            camera.width,
            surface.positions,
            surface.normals,
            transfer.free_mask,
            sets,
            observed,
            indirect.hits,
            rays.count,
            rays.on_device(engine),
            space.constant(f"cells_of_{rays.interleave}", cells_of(rays.directions.tobytes(), rays.count)),
            space.constant("cell_centers", centers.view(cl_types.float4)),
            _HALF_CELL,
            float4(*indirect.mean, 0),
            voxel_m,
            slot * self.capacity,
            self.raw,
            seen,
            self._places,
        )
        rows = engine.download(seen).astype(np.float64)
        place = engine.download(self._places[slot])[: grid.count].astype(np.float64)
        return Pools(
            grid=grid,
            seen=rows[:, :3],
            sent=rows[:, 3:6],
            unseen=rows[:, 6],
            weights=rows[:, 7],
            positions=place[:, :3],
            normals=place[:, 4:7],
            open=place[:, 7],
            beyond=indirect.mean,
        )

    def hide(self, slots: Iterable[int], planes: PlaneArrays) -> None:
        """Make `values` of `slots` anew: `raw` less what `planes` hide."""
        engine = self._engine
        directions = np.pad(spokes(), ((0, 0), (0, 0), (0, 1))).astype(np.float32).view(cl_types.float4)
        arguments = plane_arguments(engine, "pool_planes", planes)
        for slot in slots:
            engine.launch(
                self._kernel("hide_cells"),
                (self.capacity,),
                self.capacity,
                slot * self.capacity,
                self._places,
                *arguments,
                engine.workspace.constant("cell_spokes", directions),
                self.raw,
                self.values,
            )

    def shading(self, slot: int, lobes: Floats) -> NDArray[np.float32]:
        """[capacity, lobes] what each pool of a slot, if white, would show under each of `lobes` [CELLS, lobes].

        Rows past the frame's pools say nothing.
        """
        engine, count = self._engine, lobes.shape[1]
        groups = -(-count // 8)
        padded = np.zeros((CELLS, 8 * groups), np.float32)
        padded[:, :count] = lobes
        shading = engine.workspace.array("pools_shading", (self.capacity, 8 * groups), np.float32)
        engine.launch(
            self._kernel("project_pools"),
            (groups, self.capacity),
            self.capacity,
            groups,
            slot * self.capacity,
            self.values,
            engine.workspace.upload("pool_lobes", padded),
            shading,
            local=(1, 64),
        )
        result: NDArray[np.float32] = engine.download(shading)[:, :count]
        return result

    def raw_of(self, slots: NDArray[np.int64], places: NDArray[np.int64]) -> NDArray[np.float32]:
        """[n, CELLS] `raw` of the pools at `places` [n] of `slots` [n]."""
        engine, count = self._engine, len(slots)
        taken = engine.workspace.array("pools_taken", (count, CELLS), np.float32)
        chosen = engine.workspace.upload("pools_chosen", (slots * self.capacity + places).astype(np.int32))
        engine.launch(self._kernel("take_pools"), (CELLS, count), count, chosen, self.raw, taken)
        result: NDArray[np.float32] = engine.download(taken)
        return result

    def equations(self, targets: Floats, weights: Floats) -> list[CellEquations]:
        """Of each column of `targets` [slots * n, k <= 8] under `weights` [slots * n]: y = M x, M the pools' transfer.

        Summed on the device, in fixed order.
        """
        engine, space, columns = self._engine, self._engine.workspace, targets.shape[1]
        used = np.flatnonzero(weights > 0)
        room, blocks = self.slots * self.capacity, _BLOCKS * (_BLOCKS + 1) // 2
        count, chunk = len(used), max(1, -(-len(used) // _CHUNKS))
        chunks = -(-count // chunk)
        padded, numbers = np.zeros((room, 8), np.float32), np.zeros(room, np.int32)
        padded[:count, :columns], numbers[:count] = targets[used], used
        used_weights = np.zeros(room, np.float32)
        used_weights[:count] = weights[used]
        partial = space.array("cell_sums", (_CHUNKS, blocks, 8, 8), np.float32)
        engine.launch(
            self._kernel("accumulate_cells"),
            (blocks, chunks),
            count,
            chunk,
            space.upload("pool_numbers", numbers),
            self.values,
            space.upload("pool_targets", padded),
            space.upload("pool_weights", used_weights),
            partial,
            local=(16, 1),
        )
        full = _from_blocks(engine.download(partial)[:chunks].sum(axis=0, dtype=np.float64))
        energies = weights @ targets**2
        matrix, vectors = full[:CELLS, :CELLS], full[:CELLS, CELLS:]
        shared: dict[float, Floats] = {}
        return [CellEquations(matrix, vectors[:, k], float(energies[k]), shared) for k in range(columns)]

    def _kernel(self, name: str, **defines: int) -> cl.Kernel:
        shape = {"MASK_WORDS": 1, "INTERLEAVE": 1} | defines
        return self._engine.kernel("cell_transfer.cl", name, CELLS=CELLS, **shape)


def _from_blocks(blocks: Floats) -> Floats:
    """[columns, columns] symmetric, from blocks [k, 8, 8] on and above the diagonal, row by row."""
    full = np.zeros((_BLOCKS, _BLOCKS, 8, 8))
    high, low = np.triu_indices(_BLOCKS)
    full[high, low] = blocks
    full[low, high] = blocks.transpose(0, 2, 1)
    return full.transpose(0, 2, 1, 3).reshape(_COLUMNS, _COLUMNS)
