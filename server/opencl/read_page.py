"""What kernels write for the host lies together, so that one copy brings the results of several stages.

A copy is a command of its own on the device, and costs the host more than a small result is worth.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pyopencl.array as cl_array
from numpy.typing import DTypeLike, NDArray

from server.opencl.buffers import BufferDescription, StageBuffers, Workspace, new_array
from server.opencl.parts import part_alignment_bytes
from server.opencl.pending_read import PendingRead
from server.opencl.profile import Profile
from server.opencl.transfer import part_of

_LEAST_BYTES = 1 << 16
"""Of a page: a small frame's results."""
_MOST_BYTES = 1 << 24
"""Of a page, unless one array needs more: a frame of 1920x1080 reads 8 MB. For who never begins a frame."""
_MOST_PLACES = 64
"""Arrays that are kept for the next frame. A frame has about ten; more were made for other sizes of pictures."""


class _Buffers(StageBuffers):
    page = BufferDescription(np.uint8)


class PartRead(PendingRead):
    """A read of a part of the page, which is copied with the other parts that were begun before somebody needs one."""

    def __init__(self, page: ReadPage, start: int, array: cl_array.Array) -> None:
        self.start, self.stop = start, start + array.nbytes
        self._page, self._shape, self._dtype = page, array.shape, array.dtype
        self._copy: tuple[PendingRead, int] | None = None

    def sent(self, copy: PendingRead, first: int) -> None:
        """It is on its way in a copy that begins at byte `first` of the page."""
        self._copy = copy, first

    def result(self, *, is_counted: bool = False) -> NDArray[Any]:
        """As PendingRead.result; of a copy that brings several parts, the first that is asked for."""
        if self._copy is None:
            self._page.send()
        assert self._copy is not None
        copy, first = self._copy
        found: NDArray[Any] = copy.result(is_counted=is_counted)[self.start - first : self.stop - first]
        return found.view(self._dtype).reshape(self._shape)


class ReadPage:
    """Of the engines of one queue. Places are given anew in each frame, one after the other."""

    def __init__(self, workspace: Workspace, profile: Profile) -> None:
        self._workspace, self._profile = workspace, profile
        self._buffers = _Buffers(workspace)
        self._step = part_alignment_bytes(workspace.queue.device)
        self._page: cl_array.Array | None = None
        self._end = self._wanted = 0
        """Bytes that this frame has taken of the page; of all of its pages."""
        self._frame = 0
        self._places: dict[tuple[int, tuple[int, ...], np.dtype[Any]], cl_array.Array] = {}
        self._starts: dict[int, int] = {}
        """Where each array given in this frame begins, by its id."""
        self._begun: list[PartRead] = []

    def array(self, shape: tuple[int, ...], dtype: DTypeLike) -> cl_array.Array:
        """Memory of this frame, whose contents are undefined."""
        dtype = np.dtype(dtype)
        size = -(-math.prod(shape) * dtype.itemsize // self._step) * self._step
        if not size:
            return new_array(self._workspace.queue, shape, dtype)
        if self._frame != self._profile.frame:
            self._begin_frame()
        page, start = self._page, self._end
        if page is None or start + size > page.nbytes:
            page, start = self._turned(min(self._wanted, _MOST_BYTES) + size), 0
        self._end, self._wanted = start + size, self._wanted + size
        key = (start, shape, dtype)
        if key not in self._places:
            self._places[key] = part_of(page, start, shape, dtype)
        array = self._places[key]
        self._starts[id(array)] = start
        return array

    def begin(self, array: cl_array.Array) -> PartRead | None:
        """Read `array` with the next copy; None where it is none of this frame's."""
        start = self._starts.get(id(array))
        if start is None:
            return None
        self._begun.append(PartRead(self, start, array))
        return self._begun[-1]

    def send(self) -> None:
        """Begin one copy of all that was begun."""
        if not self._begun:
            return
        assert self._page is not None
        first, stop = min(part.start for part in self._begun), max(part.stop for part in self._begun)
        copy = PendingRead(self._workspace.queue, self._page[first:stop], self._profile)
        for part in self._begun:
            part.sent(copy, first)
        self._begun.clear()

    def _begin_frame(self) -> None:
        """What was begun in the last frame and nobody has needed is read before its memory is written again."""
        self.send()
        self._frame, self._end, self._wanted = self._profile.frame, 0, 0
        self._starts.clear()
        if len(self._places) > _MOST_PLACES:
            self._places.clear()

    def _turned(self, size: int) -> cl_array.Array:
        """A new page of at least so many bytes, to go on with: a frame like this one finds room for all in it."""
        self.send()
        self._buffers.page.current = None  # the old one stays as long as somebody has an array in it
        self._page = self._buffers.page.array((1 << max(size, _LEAST_BYTES).bit_length(),))
        self._places.clear()
        self._starts.clear()
        return self._page
