"""Cache of a still view: values of earlier frames, in memory that later frames do not write.

One cache per session. A value is stored under the version of its inputs and is found only by the same version.
"""

from __future__ import annotations

from dataclasses import dataclass, fields, is_dataclass, replace
from typing import Any, TypeVar, cast

import pyopencl.array as cl_array

from server.opencl.buffers import DeviceBuffer
from server.opencl.engine import Engine

T = TypeVar("T")


@dataclass(frozen=True)
class Version:
    """Version of the inputs of a cached value."""

    view: int
    """Counts the views: a still camera and scene are one view until the surface is raycast again."""
    objects: int = 0
    """Counts the changes of the virtual objects; 0 where the value does not depend on them."""
    slot: int = 0
    """Which of the direction sets that frames take turns with."""


FIRST_VERSION = Version(0)


class FrameCache:
    """Keeps the values of the newest view only, so that memory is bounded by the number of slots."""

    def __init__(self, engine: Engine) -> None:
        self._engine = engine
        self._buffers: dict[tuple[object, ...], DeviceBuffer] = {}
        self._kept: dict[tuple[type, int], tuple[Version, object]] = {}

    def find(self, kind: type[T], version: Version) -> T | None:
        """The value of a type that was kept under the same version."""
        kept = self._kept.get((kind, version.slot))
        return cast(T, kept[1]) if kept is not None and kept[0] == version else None

    def keep(self, value: T, version: Version, lasting: frozenset[str] = frozenset()) -> T:
        """Keep a copy in place of an older version of its slot; returns the copy.

        `lasting`: names of fields, at any depth, that later frames of this version do not write: they need no copy.
        """
        kept: T = self._copied(value, (type(value), version.slot), lasting)
        self._kept[type(value), version.slot] = version, kept
        return kept

    def _copied(self, value: Any, path: tuple[object, ...], lasting: frozenset[str] = frozenset()) -> Any:
        """`value` with a copy of every device array in it, in its fields and in theirs.

        path: of the value within what is kept. lasting: names of fields that are not copied.
        """
        if isinstance(value, cl_array.Array):
            key = (*path, value.dtype)
            if key not in self._buffers:
                self._buffers[key] = DeviceBuffer(self._engine.workspace, value.dtype)
            copy = self._buffers[key].array(value.shape)
            self._engine.copy_into(copy, 0, value)
            return copy
        if isinstance(value, tuple):
            return tuple(self._copied(item, (*path, i)) for i, item in enumerate(value))
        if is_dataclass(value) and not isinstance(value, type):
            names = [field.name for field in fields(value) if field.name not in lasting]
            return replace(value, **{n: self._copied(getattr(value, n), (*path, n), lasting) for n in names})
        return value
