"""What arrives at points of a room along directions: scanned surface, its back, or nothing. Kernel: arrivals.cl."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pyopencl.cltypes as cl_types
from numpy.typing import NDArray

from server.opencl.buffers import KeyedBufferDescription, StageBuffers
from server.opencl.engine import Engine
from server.opencl.pending_read import PendingRead
from server.volume.volume import Volume


class _Buffers(StageBuffers):
    """Keyed by their length, a power of two, so that a steady stream allocates nothing."""

    tables = KeyedBufferDescription(cl_types.float4)
    """Points, normals and directions."""
    arrivals = KeyedBufferDescription(cl_types.float4)


@dataclass(frozen=True)
class PendingArrivals:
    """Rays on their way."""

    read: PendingRead
    shape: tuple[int, int]
    """Points, directions of each."""

    def result(self) -> NDArray[np.float32]:
        """[n, m, 4] as of trace_arrivals, waited for."""
        return np.asarray(self.read.result().view(np.float32).reshape(*self.shape, 4))


def trace_arrivals(
    engine: Engine,
    volume: Volume,
    points: NDArray[np.float64],
    normals: NDArray[np.float64] | None,
    directions: NDArray[np.float64],
) -> NDArray[np.float32]:
    """[n, m, 4] what is first met from `points` [n, 3] (volume metres): radiance (RGB) and distance in metres.

    The distance is positive for photographed surface, negative for a surface's back or one without a colour, and 0
    where nothing is met. directions: [sets, m, 3] unit, world axes; point i takes set i modulo sets. normals: [n, 3]
    unit, of the surface that the points lie on: rays begin clear of it, those below its plane are skipped (0); None:
    they lie on none. Waits for the volume, but not for what else `engine` is at work on.
    """
    return begin_arrivals(engine, volume, points, normals, directions).result()


def begin_arrivals(
    engine: Engine,
    volume: Volume,
    points: NDArray[np.float64],
    normals: NDArray[np.float64] | None,
    directions: NDArray[np.float64],
) -> PendingArrivals:
    """The same without waiting."""
    engine = engine.concurrent
    engine.wait_for(volume.written)
    buffers, (sets, per_set, _), count = engine.buffers(_Buffers), directions.shape, len(points)
    table = np.zeros((_rounded(2 * count + sets * per_set), 4), np.float32)
    table[:count, :3] = points
    if normals is not None:
        table[count : 2 * count] = np.pad(normals, ((0, 0), (0, 1)), constant_values=1.0)
    table[2 * count : 2 * count + sets * per_set, :3] = directions.reshape(-1, 3)
    size = _rounded(count * per_set)
    arrivals = buffers.arrivals[size].array((size,))
    engine.launch(
        engine.kernel("arrivals.cl", "trace_arrivals", LANES=engine.lanes),
        (-(-per_set // engine.lanes), count),
        *volume.arguments(),
        volume.colors,
        count,
        per_set,
        sets,
        buffers.tables[len(table)].upload(table.view(cl_types.float4)[:, 0]),
        arrivals,
    )
    return PendingArrivals(engine.begin_download(arrivals[: count * per_set]), (count, per_set))


def _rounded(count: int) -> int:
    return 1 << max(count - 1, 0).bit_length()
