"""Dirty regions: arrays that are constant outside of a box, so that only the box is redrawn each frame."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from functools import reduce

import pyopencl.array as cl_array

from server.objects.pixel_boxes import PixelBox
from server.opencl.engine import Engine

EMPTY: PixelBox = (0, 0, 0, 0)


class _DirtyRegions:
    """By the name of each picture of an engine: its array, and the box outside of which it is one value."""

    def __init__(self) -> None:
        self.boxes: dict[str, tuple[cl_array.Array, PixelBox]] = {}


@contextmanager
def dirty_region(
    engine: Engine, name: str, array: cl_array.Array, box: PixelBox, whole: PixelBox
) -> Iterator[PixelBox]:
    """The box to write so that only `box` of `array` differs from the value outside: that box and the one before it.

    name: of the workspace's array. whole: all of it, for its first time. Boxes are half-open, in whatever unit.
    """
    held = engine.state(_DirtyRegions).boxes
    before = held.get(name)
    region = union(before[1], box) if before is not None and before[0] is array else whole
    held[name] = (array, region)  # so much may differ where this frame fails
    yield region
    held[name] = (array, box)


def box_around(boxes: Sequence[PixelBox | None]) -> PixelBox:
    """The box around all that there are."""
    return reduce(union, (box for box in boxes if box is not None), EMPTY)


def union(a: PixelBox, b: PixelBox) -> PixelBox:
    """The box around both."""
    if is_empty(a) or is_empty(b):
        return b if is_empty(a) else a
    return min(a[0], b[0]), min(a[1], b[1]), max(a[2], b[2]), max(a[3], b[3])


def is_empty(box: PixelBox) -> bool:
    """Whether nothing lies in it."""
    return box[0] >= box[2] or box[1] >= box[3]
