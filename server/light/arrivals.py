"""What arrives at points of a room along directions: scanned surface, its back, or nothing. Kernel: arrivals.cl."""

from __future__ import annotations

import numpy as np
import pyopencl.cltypes as cl_types
from numpy.typing import NDArray

from server.opencl.buffers import KeyedBufferDescription, StageBuffers
from server.opencl.engine import Engine
from server.volume.volume import Volume


class _Buffers(StageBuffers):
    """Keyed by the number of points, rounded up to a power of two, so that a steady stream allocates nothing."""

    points = KeyedBufferDescription(cl_types.float4)
    normals = KeyedBufferDescription(cl_types.float4)
    directions = KeyedBufferDescription(cl_types.float4)
    """Keyed by the number of sets, rounded, and of directions."""
    arrivals = KeyedBufferDescription(cl_types.float4)
    """Keyed by the number of points, rounded, and of directions."""


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
    engine = engine.aside
    engine.wait_for(volume.written)
    buffers, (sets, per_set, _), count = engine.buffers(_Buffers), directions.shape, len(points)
    room, room_of_sets = _rounded(count), _rounded(sets)
    planes = np.zeros((count, 4)) if normals is None else np.pad(normals, ((0, 0), (0, 1)), constant_values=1.0)
    arrivals = buffers.arrivals[room, per_set].array((room, per_set))
    engine.launch(
        engine.kernel("arrivals.cl", "trace_arrivals", LANES=engine.lanes),
        (-(-per_set // engine.lanes), count),
        *volume.arguments(),
        volume.colors,
        count,
        per_set,
        sets,
        buffers.points[room].upload(_float4(points, room)),
        buffers.normals[room].upload(_float4(planes, room)),
        buffers.directions[room_of_sets, per_set].upload(_float4(directions, room_of_sets)),
        arrivals,
    )
    return np.asarray(engine.download(arrivals).view(np.float32).reshape(room, per_set, 4)[:count])


def _rounded(count: int) -> int:
    return 1 << max(count - 1, 0).bit_length()


def _float4(vectors: NDArray[np.float64], room: int) -> NDArray[np.void]:
    """[room, ...] float4 of [n, ..., 3 or 4], the rest zeros."""
    padded: NDArray[np.float32] = np.zeros((room, *vectors.shape[1:-1], 4), np.float32)
    padded[: len(vectors), ..., : vectors.shape[-1]] = vectors
    return padded.view(cl_types.float4)[..., 0]
