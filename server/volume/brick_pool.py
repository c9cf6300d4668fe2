"""Device memory for the bricks' voxels, which grows with the surface. Kernels: brick_pool.cl."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
import pyopencl as cl
import pyopencl.array as cl_array
import pyopencl.cltypes as cl_types
from numpy.typing import NDArray

from server.opencl.engine import Engine
from server.opencl.transfer import copy_beginning, fill_bytes

BRICK_VOXELS = 512
BRICK_CELLS = 64
BRICK_BYTES = 12 * BRICK_VOXELS + BRICK_CELLS
"""Of one brick in the pool: tsdf and weight, colour, octets."""
_BATCH = 1024
"""Bricks that are copied between device and host at once."""


class BrickPool:
    """Slots 1 to `capacity`; slot 0 stands for all bricks that are not on the device."""

    def __init__(self, engine: Engine) -> None:
        self._engine = engine
        self.capacity = 0
        space = engine.workspace
        self.voxels: cl_array.Array = space.array("voxels", (1, BRICK_VOXELS), cl_types.float2)
        self.colors: cl_array.Array = space.array("voxel_colors", (1, BRICK_VOXELS), np.uint32)
        self.octets: cl_array.Array = space.array("solid_octets", (1, BRICK_CELLS), np.uint8)
        fill_bytes(engine.queue, self.voxels, 0)
        fill_bytes(engine.queue, self.colors, 0)
        fill_bytes(engine.queue, self.octets, 255)  # rays stop at what is away, but nothing is interpolated

    @property
    def bytes_held(self) -> int:
        """Device memory of all slots."""
        return int(self.voxels.nbytes + self.colors.nbytes + self.octets.nbytes)

    def grow(self, capacity: int) -> None:
        """Have `capacity` slots; contents stay. One array at a time lies there twice for a moment."""
        self.capacity = capacity
        self.voxels = self._grown("voxels", self.voxels)
        self.colors = self._grown("voxel_colors", self.colors)
        self.octets = self._grown("solid_octets", self.octets)

    def clear(self, slots: NDArray[np.int32]) -> None:
        """Make voxels unseen and colourless."""
        self._over_rows("claim_bricks", len(slots), self._list("claimed", slots), self.voxels, self.colors)

    def download(self, slots: NDArray[np.int32]) -> Iterator[tuple[slice, NDArray[Any], NDArray[np.uint32]]]:
        """In batches: which of `slots`, their voxels [k, 512] float2, their colours [k, 512]."""
        for batch in _batches(len(slots)):
            voxels, colors, rows = self._staging(batch)
            chosen = self._list("copied", slots[batch])
            self._over_rows("copy_bricks", len(slots[batch]), chosen, self.voxels, self.colors, rows, voxels, colors)
            count = len(slots[batch])
            yield batch, self._engine.download(voxels)[:count], self._engine.download(colors)[:count]

    def upload(self, slots: NDArray[np.int32], voxels: NDArray[Any], colors: NDArray[np.uint32]) -> None:
        """Fill slots with voxels [n, 512] float2 and colours [n, 512]."""
        for batch in _batches(len(slots)):
            staged_voxels, staged_colors, rows = self._staging(batch)
            copy_beginning(self._engine.queue, staged_voxels, voxels[batch])
            copy_beginning(self._engine.queue, staged_colors, colors[batch])
            chosen = self._list("copied", slots[batch])
            self._over_rows(
                "copy_bricks", len(slots[batch]), rows, staged_voxels, staged_colors, chosen, self.voxels, self.colors
            )

    def _grown(self, name: str, old: cl_array.Array) -> cl_array.Array:
        new = self._engine.workspace.array(name, (self.capacity + 1, *old.shape[1:]), old.dtype)
        copy_beginning(self._engine.queue, new, old)
        self._engine.queue.finish()
        if isinstance(old.data, cl.Buffer):
            old.data.release()
        return new

    def _staging(self, batch: slice) -> tuple[cl_array.Array, cl_array.Array, cl_array.Array]:
        """Voxels and colours of one batch between device and host, and the rows of it that are used."""
        space = self._engine.workspace
        rows = min(_BATCH, rounded(batch.stop - batch.start))
        return (
            space.array("staged_voxels", (rows, BRICK_VOXELS), cl_types.float2),
            space.array("staged_colors", (rows, BRICK_VOXELS), np.uint32),
            space.constant("staged_rows", np.arange(_BATCH, dtype=np.int32)),
        )

    def _over_rows(self, kernel: str, count: int, *arguments: cl_array.Array) -> None:
        if count:
            size = (BRICK_CELLS * count,)
            self._engine.launch(self._engine.kernel("brick_pool.cl", kernel), size, count, *arguments)

    def _list(self, name: str, values: NDArray[np.int32]) -> cl_array.Array:
        return upload_list(self._engine, f"pool_{name}", values)


def upload_list(engine: Engine, name: str, values: NDArray[np.int32]) -> cl_array.Array:
    """[n or more] int32 on the device, the first n of them `values`: a list whose length changes keeps its memory."""
    array = engine.workspace.array(name, (rounded(len(values)),), np.int32)
    copy_beginning(engine.queue, array, values)
    return array


def rounded(count: int) -> int:
    """Length of a buffer for a list of about `count`: only now and then another."""
    return 1 << max(10, (count - 1).bit_length())


def _batches(count: int) -> Iterator[slice]:
    for start in range(0, count, _BATCH):
        yield slice(start, min(start + _BATCH, count))
