"""Guard bytes behind every device buffer: a kernel that writes past the end of a buffer fails its test.

The bytes are 0xFF, which is NaN as a float and -1 as an integer, so that a value that is read past the end is seen too.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import pyopencl as cl
import pyopencl.array as cl_array
import pytest
from numpy.typing import DTypeLike

from server.opencl import buffers
from server.opencl.buffers import Workspace

GUARD_BYTES = 1024
"""A wrong bound is off by a work-group at most: 64 items of 16 bytes."""
_release = Workspace.release


def install(monkeypatch: pytest.MonkeyPatch) -> None:
    """Buffers get guards, which are checked when their workspace is released."""
    monkeypatch.setattr(buffers, "new_array", guarded_array)
    monkeypatch.setattr(Workspace, "release", check_and_release)


def guarded_array(queue: cl.CommandQueue, shape: tuple[int, ...], dtype: DTypeLike) -> cl_array.Array:
    """In place of server.opencl.buffers.new_array."""
    size = int(np.prod(shape)) * np.dtype(dtype).itemsize
    if not size:
        return cl_array.empty(queue, shape, dtype)
    memory = cl.Buffer(queue.context, cl.mem_flags.READ_WRITE, size + GUARD_BYTES)
    cl.enqueue_fill_buffer(queue, memory, np.array([0xFF], np.uint8), size, GUARD_BYTES)
    return cl_array.Array(queue, shape, dtype, data=memory)


def check_and_release(workspace: Workspace) -> None:
    """In place of Workspace.release. Raises AssertionError where a guard was written."""
    written = [
        f"{array.shape} of {array.dtype}" for array in workspace.arrays() if array.nbytes and not _is_whole(array)
    ]
    _release(workspace)
    assert not written, f"a kernel wrote past the end of a buffer {', '.join(written)}"


def _is_whole(array: Any) -> bool:
    guard = np.empty(GUARD_BYTES, np.uint8)
    cl.enqueue_copy(array.queue, guard, array.base_data, src_offset=array.nbytes)
    return bool((guard == 0xFF).all())
