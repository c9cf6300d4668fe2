"""What arrives at points of a room along directions: scanned surface, its back, or nothing. Kernel: arrivals.cl."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import pyopencl.cltypes as cl_types
from numpy.typing import NDArray

from server.opencl.buffers import KeyedBufferDescription, StageBuffers
from server.opencl.engine import Engine
from server.opencl.pending_read import PendingRead
from server.opencl.structs import RAY_GROUP
from server.volume.volume import Volume

MOST_GROUPS = 3
"""Of rays that one launch traces: those of patches, and towards lamps from patches that are new and from others."""
_NO_GROUP = RAY_GROUP(first_item=2**31 - 1, count=0, per_set=0, sets=0, first_row=0, first_arrival=0)


class _Buffers(StageBuffers):
    """Keyed by their length, a power of two, so that a steady stream allocates nothing."""

    tables = KeyedBufferDescription(cl_types.float4)
    """Points, normals and directions, group by group."""
    arrivals = KeyedBufferDescription(cl_types.float4)


@dataclass(frozen=True)
class RayGroup:
    """Rays from points along directions."""

    points: NDArray[np.float64]
    """[n, 3] volume metres."""
    normals: NDArray[np.float64] | None
    """[n, 3] unit, of the surface that the points lie on: rays begin clear of it, those below its plane are skipped.
    None: they lie on none."""
    directions: NDArray[np.float64]
    """[sets, m, 3] unit, world axes; point i takes set i modulo sets."""

    @property
    def shape(self) -> tuple[int, int]:
        """Points, directions of each."""
        return len(self.points), self.directions.shape[1]

    def table(self) -> NDArray[np.float32]:
        """[2 n + sets m, 4] its rows of the table that the kernel reads."""
        count = len(self.points)
        rows = np.zeros((2 * count + self.directions.size // 3, 4), np.float32)
        rows[:count, :3] = self.points
        if self.normals is not None:
            rows[count : 2 * count, :3], rows[count : 2 * count, 3] = self.normals, 1.0
        rows[2 * count :, :3] = self.directions.reshape(-1, 3)
        return rows


@dataclass(frozen=True)
class PendingArrivals:
    """Rays of some groups on their way."""

    read: PendingRead
    shapes: tuple[tuple[int, int], ...]

    def results(self) -> list[NDArray[np.float32]]:
        """[n, m, 4] of each group, as of trace_arrivals, waited for."""
        arrivals = self.read.result().view(np.float32).reshape(-1, 4)
        ends = np.cumsum([points * directions for points, directions in self.shapes])
        return [part.reshape(*shape, 4) for part, shape in zip(np.split(arrivals, ends[:-1]), self.shapes, strict=True)]


def trace_arrivals(engine: Engine, volume: Volume, rays: RayGroup) -> NDArray[np.float32]:
    """[n, m, 4] what is first met from each point: radiance (RGB) and distance in metres.

    The distance is positive for photographed surface, negative for a surface's back or one without a colour, and 0
    where nothing is met or the direction is skipped. Waits for the volume, but not for what else `engine` is at work
    on.
    """
    return begin_arrivals(engine, volume, [rays]).results()[0]


def begin_arrivals(engine: Engine, volume: Volume, groups: Sequence[RayGroup]) -> PendingArrivals:
    """The same without waiting, for 1 to MOST_GROUPS groups at once."""
    engine = engine.concurrent
    engine.wait_for(volume.written)
    buffers, tables, arguments = engine.buffers(_Buffers), [], [_NO_GROUP] * MOST_GROUPS
    items = rows = rays = 0
    for number, group in enumerate(groups):
        count, per_set = group.shape
        arguments[number] = RAY_GROUP(
            first_item=items,
            count=count,
            per_set=per_set,
            sets=len(group.directions),
            first_row=rows,
            first_arrival=rays,
        )
        tables.append(group.table())
        items, rows = items + count * -(-per_set // engine.lanes), rows + len(tables[-1])
        rays += count * per_set
    table = np.zeros((_rounded(rows), 4), np.float32)
    np.concatenate(tables, out=table[:rows])
    size = _rounded(rays)
    arrivals = buffers.arrivals[size].array((size,))
    engine.launch(
        engine.kernel("arrivals.cl", "trace_arrivals", LANES=engine.lanes),
        (items,),
        *volume.arguments(),
        volume.colors,
        items,
        *arguments,
        buffers.tables[len(table)].upload(table.view(cl_types.float4)[:, 0]),
        arrivals,
    )
    return PendingArrivals(engine.begin_download(arrivals[:rays]), tuple(group.shape for group in groups))


def _rounded(count: int) -> int:
    return 1 << max(count - 1, 0).bit_length()
