"""Dirty regions: arrays that are constant outside of a box, so that only the box is redrawn each frame."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from functools import reduce

import pyopencl.array as cl_array

from server.objects.pixel_boxes import PixelBox

EMPTY: PixelBox = (0, 0, 0, 0)


class DirtyRegion:
    """The box of an array outside of which it is constant. Belongs to whoever owns the array's buffer."""

    def __init__(self) -> None:
        self._array: cl_array.Array | None = None
        self._box = EMPTY

    @contextmanager
    def redraw(self, array: cl_array.Array, box: PixelBox, whole: PixelBox) -> Iterator[PixelBox]:
        """The box to write within the context so that `array` is constant outside of `box`: it includes the last box.

        whole: the box of the whole array, which is written the first time. Boxes are half-open, in any unit.
        """
        region = union(self._box, box) if self._array is array else whole
        self._array, self._box = array, region  # this much may differ if this frame fails
        yield region
        self._box = box


def box_around(boxes: Sequence[PixelBox | None]) -> PixelBox:
    """The box around all boxes; EMPTY without any."""
    return reduce(union, (box for box in boxes if box is not None), EMPTY)


def union(a: PixelBox, b: PixelBox) -> PixelBox:
    """The box around both."""
    if is_empty(a) or is_empty(b):
        return b if is_empty(a) else a
    return min(a[0], b[0]), min(a[1], b[1]), max(a[2], b[2]), max(a[3], b[3])


def is_empty(box: PixelBox) -> bool:
    """Whether nothing lies in it."""
    return box[0] >= box[2] or box[1] >= box[3]
