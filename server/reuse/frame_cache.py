"""What a still view needs again: arrays of earlier frames, copied to where later ones do not write."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields, is_dataclass, replace
from typing import Any, TypeVar

import numpy as np
import pyopencl.array as cl_array
from numpy.typing import NDArray

from protocol.messages import Plan
from server.input.measure import Measurement
from server.opencl.engine import Engine
from server.opencl.transfer import copy_into
from server.transfer.indirect import Indirect
from server.transfer.radiance_transfer import Transfer

T = TypeVar("T")

LASTING = frozenset({"virtual", "coverage"})
"""The same in every turn, and written where an object has moved only."""


@dataclass(frozen=True)
class TransferSamples:
    """Transfer of one frame, and what its surfaces send one another."""

    transfer: Transfer | None
    """None: nothing asked for it."""
    indirect: Indirect | None


@dataclass(frozen=True)
class CachedEffects:
    """One turn's effects: what the picture is put together from, and the plan that made it."""

    parts: Mapping[str, Any]
    plan: Plan


class FrameCache:
    """One session's. Frames take turns with direction sets, so there is one of each for every turn."""

    def __init__(self, engine: Engine) -> None:
        self._engine = engine
        self.sampled: dict[int, TransferSamples] = {}
        self.finished: dict[int, CachedEffects] = {}
        self.old: tuple[NDArray[np.uint8], Measurement] | None = None
        """What the camera saw when the view began to stand still: as sRGB, and as measured."""

    def forget(self) -> None:
        """The view is another."""
        self.sampled.clear()
        self.finished.clear()
        self.old = None

    def keep_old(self, shown: NDArray[np.uint8], measurement: Measurement) -> tuple[NDArray[np.uint8], Measurement]:
        """What was kept first of these."""
        if self.old is None:
            self.old = shown.copy(), copied(self._engine, measurement, "held_measurement")
        return self.old

    def keep_sampled(self, turn: int, sampled: TransferSamples) -> None:
        """Copy a turn's transfer, and what surfaces send."""
        self.sampled[turn] = copied(self._engine, sampled, f"held_{turn}")

    def keep_finished(self, turn: int, parts: Mapping[str, Any], plan: Plan) -> None:
        """Copy what a turn's picture was put together from."""
        kept = {
            name: part if name in LASTING else copied(self._engine, part, f"held_{turn}_{name}")
            for name, part in parts.items()
        }
        self.finished[turn] = CachedEffects(kept, plan)


def copied(engine: Engine, value: T, name: str) -> T:
    """`value` with every device array of it, of its fields and of theirs, in an array of its own under `name`."""
    if isinstance(value, cl_array.Array):
        copy = engine.workspace.array(name, value.shape, value.dtype)
        copy_into(engine.queue, copy, 0, value)
        return copy  # type: ignore[return-value]
    if isinstance(value, tuple):
        return tuple(copied(engine, item, f"{name}_{i}") for i, item in enumerate(value))  # type: ignore[return-value]
    if is_dataclass(value) and not isinstance(value, type):
        changes = {f.name: copied(engine, getattr(value, f.name), f"{name}_{f.name}") for f in fields(value)}
        return replace(value, **changes)
    return value
