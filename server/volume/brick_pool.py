"""Device memory for the bricks' voxels, which grows with the surface. Kernels: brick_pool.cl."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
import pyopencl as cl
import pyopencl.array as cl_array
import pyopencl.cltypes as cl_types
from numpy.typing import NDArray

from server.opencl.buffers import BufferDescription, DeviceBuffer, StageBuffers
from server.opencl.engine import Engine
from server.opencl.transfer import fill_bytes

BRICK_VOXELS = 512
BRICK_CELLS = 64
BRICK_BYTES = 12 * BRICK_VOXELS + BRICK_CELLS
"""Device memory of one brick: tsdf and weight, colour, octets."""
_BATCH = 1024
"""Bricks per copy between device and host."""


class _Buffers(StageBuffers):
    voxels = BufferDescription(cl_types.float2)
    """[slots, 512] tsdf, weight."""
    colors = BufferDescription(np.uint32)
    """[slots, 512] packed as in bricks.py."""
    octets = BufferDescription(np.uint8)
    """[slots, 64] see include/volume.clh."""
    copied_slots = BufferDescription(np.int32)
    """[n or more]"""
    staged_voxels = BufferDescription(cl_types.float2)
    """[rows, 512] a batch between device and host."""
    staged_colors = BufferDescription(np.uint32)
    """[rows, 512] likewise."""
    staged_rows = BufferDescription(np.int32)
    """[_BATCH] numbers of the rows."""


class BrickPool:
    """Slots 1 to `capacity`; slot 0 represents all bricks that are on the host."""

    def __init__(self, engine: Engine) -> None:
        self._engine, self._buffers = engine, _Buffers(engine.workspace)
        self.capacity = 0
        self.voxels: cl_array.Array = self._buffers.voxels.array((1, BRICK_VOXELS))
        self.colors: cl_array.Array = self._buffers.colors.array((1, BRICK_VOXELS))
        self.octets: cl_array.Array = self._buffers.octets.array((1, BRICK_CELLS))
        fill_bytes(engine.queue, self.voxels, 0)
        fill_bytes(engine.queue, self.colors, 0)
        fill_bytes(engine.queue, self.octets, 255)  # bricks on the host block rays, but are not interpolated

    @property
    def bytes_held(self) -> int:
        """Device memory of all slots."""
        return int(self.voxels.nbytes + self.colors.nbytes + self.octets.nbytes)

    def grow(self, capacity: int) -> None:
        """Grow to `capacity` slots and keep the contents. At most one array at a time exists twice."""
        self.capacity = capacity
        self.voxels = self._grown(self._buffers.voxels, self.voxels)
        self.colors = self._grown(self._buffers.colors, self.colors)
        self.octets = self._grown(self._buffers.octets, self.octets)

    def download(self, slots: NDArray[np.int32]) -> Iterator[tuple[slice, NDArray[Any], NDArray[np.uint32]]]:
        """Batches: slice of `slots`, voxels [k, 512] float2, colours [k, 512]."""
        for batch in _batches(len(slots)):
            voxels, colors, rows = self._staging(batch)
            chosen = upload_list(self._engine, self._buffers.copied_slots, slots[batch])
            self._over_rows("copy_bricks", len(slots[batch]), chosen, self.voxels, self.colors, rows, voxels, colors)
            count = len(slots[batch])
            yield batch, self._engine.download(voxels)[:count], self._engine.download(colors)[:count]

    def upload(self, slots: NDArray[np.int32], voxels: NDArray[Any], colors: NDArray[np.uint32]) -> None:
        """Fill slots with voxels [n, 512] float2 and colours [n, 512]."""
        for batch in _batches(len(slots)):
            staged_voxels, staged_colors, rows = self._staging(batch)
            self._engine.workspace.copy(staged_voxels, voxels[batch])
            self._engine.workspace.copy(staged_colors, colors[batch])
            chosen = upload_list(self._engine, self._buffers.copied_slots, slots[batch])
            self._over_rows(
                "copy_bricks", len(slots[batch]), rows, staged_voxels, staged_colors, chosen, self.voxels, self.colors
            )

    def forget_colors(self, share: float) -> None:
        """Take `share` of their weight from all means of colour."""
        slots = self.capacity + 1
        kernel = self._engine.kernel("brick_pool.cl", "forget_colors")
        self._engine.launch(kernel, (BRICK_CELLS * slots,), slots, np.float32(1 - share), self.colors)

    def _grown(self, buffer: DeviceBuffer, old: cl_array.Array) -> cl_array.Array:
        new = buffer.array((self.capacity + 1, *old.shape[1:]))
        self._engine.copy_into(new, 0, old)
        self._engine.queue.finish()
        if isinstance(old.data, cl.Buffer):
            old.data.release()
        return new

    def _staging(self, batch: slice) -> tuple[cl_array.Array, cl_array.Array, cl_array.Array]:
        """Staged voxels and colours of one batch, and the numbers of their rows."""
        rows = min(_BATCH, rounded(batch.stop - batch.start))
        return (
            self._buffers.staged_voxels.array((rows, BRICK_VOXELS)),
            self._buffers.staged_colors.array((rows, BRICK_VOXELS)),
            self._buffers.staged_rows.constant(np.arange(_BATCH, dtype=np.int32)),
        )

    def _over_rows(self, kernel: str, count: int, *arguments: cl_array.Array) -> None:
        if count:
            size = (BRICK_CELLS * count,)
            self._engine.launch(self._engine.kernel("brick_pool.cl", kernel), size, count, *arguments)


def upload_list(engine: Engine, buffer: DeviceBuffer, values: NDArray[np.int32]) -> cl_array.Array:
    """Copy `values` into the first elements of an int32 buffer, whose length rarely changes."""
    array = buffer.array((rounded(len(values)),))
    engine.workspace.copy(array, values)
    return array


def rounded(count: int) -> int:
    """Length of a buffer for a list of `count`: a power of two, so that it rarely changes."""
    return 1 << max(10, (count - 1).bit_length())


def _batches(count: int) -> Iterator[slice]:
    for start in range(0, count, _BATCH):
        yield slice(start, min(start + _BATCH, count))
