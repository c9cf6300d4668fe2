"""Tables for empty-space skipping: solid cells and the gaps between them. Kernels: volume.cl."""

from __future__ import annotations

import numpy as np
import pyopencl.array as cl_array
from numpy.typing import NDArray

from server.opencl.buffers import BufferDescription, KeyedBufferDescription, StageBuffers
from server.opencl.engine import Engine, int4
from server.opencl.parts import part_alignment_bytes
from server.opencl.transfer import fill_bytes, part_of
from server.volume.brick_pool import BrickPool, rounded, upload_list

GREATEST_GAP = 15
_CELL_ROWS = 16
_SLICE_ITEMS = 64  # of a group of gaps_in_slices
_UNCHANGED = -(1 << 30)  # below all bricks


class _Buffers(StageBuffers):
    tables = BufferDescription(np.uint8)
    """The solid cells, uint64 [z, y, x], and the gaps, uint8 [octant, z, y, x], behind them."""
    occupied = BufferDescription(np.uint8)
    """[brick] 1 if it had a solid voxel at the last update."""
    inner_gaps = KeyedBufferDescription(np.uint8)
    """Key 0: gaps along x, [2 bricks + 16]; key 1: along x and y, [4 bricks + 16]."""
    changed = BufferDescription(np.int32)
    """[6] lowest x, y, z, negated, and highest of the bricks that have changed."""
    near_solid = BufferDescription(np.uint8)
    """[n or more] 1 for listed bricks near a solid voxel."""
    idle_bricks = BufferDescription(np.int32)
    """[n or more]"""


class RayTables:
    """Solid cells and gaps of all bricks, [z, y, x]; see include/volume.clh."""

    def __init__(self, engine: Engine, bricks: tuple[int, int, int]) -> None:
        self._engine, self._buffers = engine, _Buffers(engine.workspace)
        self.bricks = bricks
        count = bricks[0] * bricks[1] * bricks[2]
        step = part_alignment_bytes(engine.device.cl_device)
        self.gaps_at = -(-8 * count // step) * step
        """Byte of `memory` at which the gaps begin."""
        self.memory: cl_array.Array = self._buffers.tables.array((self.gaps_at + 8 * count,))
        """The solid cells, and the gaps behind them: kernels take both as one argument."""
        self.solid: cl_array.Array = part_of(self.memory, 0, bricks[::-1], np.uint64)
        self.gaps: cl_array.Array = part_of(self.memory, self.gaps_at, (8 * count,), np.uint8)
        self._occupied = self._buffers.occupied.array((count,))
        self._inner = [self._buffers.inner_gaps[axis].array(((2 << axis) * count + 16,)) for axis in range(2)]
        self._changed = self._buffers.changed.array((6,))
        for array, value in ((self.solid, 0), (self._occupied, 255)):  # 255: every brick counts as changed
            fill_bytes(engine.queue, array, value)

    @property
    def bytes_held(self) -> int:
        """Device memory."""
        return sum(a.nbytes for a in (self.memory, self._occupied, self._changed, *self._inner))

    def find_solid(self, listed: cl_array.Array, count: int, slots: cl_array.Array, pool: BrickPool) -> None:
        """Compute solid cells and octets of the first `count` listed bricks."""
        self._engine.launch(
            self._engine.kernel("volume.cl", "find_solid"),
            (_CELL_ROWS * count,),
            count,
            listed,
            slots,
            pool.voxels,
            self.solid,
            pool.octets,
        )

    def near_solid(self, indices: NDArray[np.int32]) -> NDArray[np.bool_]:
        """[n] whether a brick, or the 4 voxels around it, contain a known solid voxel."""
        near = self._buffers.near_solid.array((rounded(len(indices)),))
        listed = upload_list(self._engine, self._buffers.idle_bricks, indices)
        kernel = self._engine.kernel("volume.cl", "find_near_solid")
        self._engine.launch(kernel, (len(indices),), len(indices), listed, int4(*self.bricks, 0), self.solid, near)
        found: NDArray[np.bool_] = self._engine.download(near)[: len(indices)].view(np.bool_)
        return found

    def update(self) -> None:
        """Recompute the gaps around bricks that have become solid or empty."""
        engine, (x, y, z), bricks = self._engine, self.bricks, int4(*self.bricks, 0)
        engine.fill(self._changed, _UNCHANGED)
        engine.launch(
            engine.kernel("volume.cl", "gaps_in_slices"),
            (_SLICE_ITEMS * z,),
            bricks,
            self.solid,
            GREATEST_GAP,
            self._occupied,
            self._changed,
            *self._inner,
            local=(_SLICE_ITEMS,),
        )
        engine.launch(
            engine.kernel("volume.cl", "gaps_along_z"),
            (-(-x // 16), y, 8 * z),
            bricks,
            self._inner[1],
            GREATEST_GAP,
            self._changed,
            self.gaps,
            local=(1, 8, 8),
        )
