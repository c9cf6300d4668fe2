"""The one place for device memory of a session: named arrays, made on first use and kept."""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping
from typing import Any, cast

import numpy as np
import pyopencl as cl
import pyopencl.array as cl_array
from numpy.typing import DTypeLike, NDArray

from server.opencl.parts import Parts, pack, part_alignment_bytes, place


class Workspace:
    """Named device arrays; the same name and shape is the same memory, so a steady stream allocates nothing."""

    def __init__(self, queue: cl.CommandQueue) -> None:
        self._queue = queue
        self._arrays: dict[str, cl_array.Array] = {}
        self._copying: deque[tuple[cl.Event, NDArray[Any]]] = deque()

    def array(self, name: str, shape: tuple[int, ...], dtype: DTypeLike) -> cl_array.Array:
        """The array called `name`; contents are kept while shape and dtype stay, undefined after they change."""
        found = self._arrays.get(name)
        if found is None or found.shape != shape or found.dtype != np.dtype(dtype):
            found = self._arrays[name] = cl_array.empty(self._queue, shape, dtype)
        return found

    def find(self, name: str) -> cl_array.Array | None:
        """The array called `name` as it is, None before its first use."""
        return self._arrays.get(name)

    def upload(self, name: str, values: NDArray[Any]) -> cl_array.Array:
        """Copy `values` into the array called `name`, once what is queued has run; they may change right away."""
        array = self.array(name, values.shape, values.dtype)
        if array.nbytes:  # to wait for the copy would be to wait for all that is queued before it
            memory, copied = cast(Any, array.data), np.array(values, order="C")
            self._copying.append((cl.enqueue_copy(self._queue, memory, copied, is_blocking=False), copied))
        while self._copying and self._copying[0][0].command_execution_status == cl.command_execution_status.COMPLETE:
            self._copying.popleft()
        return array

    def constant(self, name: str, values: NDArray[Any]) -> cl_array.Array:
        """The array called `name`, copied from `values` the first time only; `values` must not change."""
        found = self._arrays.get(name)
        if found is not None and found.shape == values.shape and found.dtype == values.dtype:
            return found
        return self.upload(name, values)

    def parts(self, name: str, shapes: Mapping[str, tuple[tuple[int, ...], DTypeLike]]) -> Parts:
        """Arrays in one buffer called `name`; contents are kept as `array` does."""
        starts, size = place(shapes, part_alignment_bytes(self._queue.device))
        return Parts(self.array(name, (size,), np.uint8), starts, shapes)

    def upload_parts(self, name: str, arrays: Mapping[str, NDArray[Any]], *, is_constant: bool = False) -> Parts:
        """Copy `arrays` into one buffer called `name`; is_constant: the first time only, as `constant` does."""
        shapes = {part: (values.shape, values.dtype) for part, values in arrays.items()}
        starts, size = place(shapes, part_alignment_bytes(self._queue.device))
        packed = pack(arrays, starts, size)
        memory = self.constant(name, packed) if is_constant else self.upload(name, packed)
        return Parts(memory, starts, shapes)

    @property
    def bytes_held(self) -> int:
        """Device memory of all arrays."""
        return sum(array.nbytes for array in tuple(self._arrays.values()))  # asked for by other threads too

    def release(self) -> None:
        """Give all device memory back."""
        self._copying.clear()
        for array in self._arrays.values():
            if isinstance(array.base_data, cl.MemoryObject):
                array.base_data.release()
        self._arrays.clear()
