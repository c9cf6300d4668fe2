"""Raw memory: fills that pyopencl's arrays would launch kernels of their own for, and parts."""

from __future__ import annotations

from typing import cast

import numpy as np
import pyopencl as cl
import pyopencl.array as cl_array
from numpy.typing import DTypeLike


def fill_bytes(queue: cl.CommandQueue, array: cl_array.Array, value: int) -> None:
    """Set every byte of `array` to `value`, 0 to 255."""
    if array.nbytes:
        cl.enqueue_fill_buffer(queue, _memory(array), np.array([value], np.uint8), 0, array.nbytes)


def part_of(whole: cl_array.Array, start: int, shape: tuple[int, ...], dtype: DTypeLike) -> cl_array.Array:
    """An array in the memory of `whole`, from its byte `start` on, a multiple of
    part_alignment_bytes (parts.py)."""
    size = int(np.prod(shape)) * np.dtype(dtype).itemsize
    return cl_array.Array(whole.queue, shape, dtype, data=_memory(whole).get_sub_region(start, size))


def _memory(array: cl_array.Array) -> cl.Buffer:
    assert isinstance(array.data, cl.MemoryObject)
    return cast(cl.Buffer, array.data)
