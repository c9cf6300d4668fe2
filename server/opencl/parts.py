"""Several small arrays in one buffer, which a kernel takes as one argument; its struct says where each begins."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import pyopencl as cl
import pyopencl.array as cl_array
from numpy.typing import DTypeLike, NDArray

from server.opencl.transfer import part_of

LEAST_ALIGNMENT_BYTES = 64
"""Alignment of a float16, the largest type that kernels load."""
_STEP_BYTES = 4096
"""Buffers grow in such steps, so that a part that changes by little seldom takes new memory."""


Shapes = Mapping[str, tuple[tuple[int, ...], DTypeLike]]
"""Shape and type of each part."""


@dataclass(frozen=True)
class Parts:
    """Arrays in one buffer on the device."""

    memory: cl_array.Array
    """All parts, uint8."""
    starts: Mapping[str, int]
    """Byte at which each begins."""
    shapes: Shapes

    def array(self, name: str) -> cl_array.Array:
        """One part, in the same memory."""
        return part_of(self.memory, self.starts[name], *self.shapes[name])


def part_alignment_bytes(device: cl.Device) -> int:
    """Alignment of a part: of the device's sub-buffers and of the largest type."""
    return max(device.mem_base_addr_align // 8, LEAST_ALIGNMENT_BYTES)


def place(shapes: Shapes, alignment_bytes: int) -> tuple[dict[str, int], int]:
    """Where each array begins, one after the other, and the bytes in all."""
    starts, end = {}, 0
    for name, (shape, dtype) in shapes.items():
        starts[name] = -(-end // alignment_bytes) * alignment_bytes
        end = starts[name] + math.prod(shape) * np.dtype(dtype).itemsize
    return starts, -(-max(end, 1) // _STEP_BYTES) * _STEP_BYTES


def pack(arrays: Mapping[str, NDArray[Any]], starts: Mapping[str, int], size: int) -> NDArray[np.uint8]:
    """The bytes of `arrays`, each where it begins."""
    packed = np.zeros(size, np.uint8)
    for name, values in arrays.items():
        packed[starts[name] : starts[name] + values.nbytes] = np.ascontiguousarray(values).view(np.uint8).ravel()
    return packed
