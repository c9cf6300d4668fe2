"""What arrives at points of a room along directions: scanned surface, its back, or nothing. Kernel: arrivals.cl."""

from __future__ import annotations

import numpy as np
import pyopencl.cltypes as cl_types
from numpy.typing import NDArray

from server.opencl.buffers import BufferDescription, StageBuffers
from server.opencl.engine import Engine
from server.volume.volume import Volume


class _Buffers(StageBuffers):
    points = BufferDescription(cl_types.float4)
    normals = BufferDescription(cl_types.float4)
    directions = BufferDescription(cl_types.float4)
    arrivals = BufferDescription(cl_types.float4)


def trace_arrivals(
    engine: Engine,
    volume: Volume,
    points: NDArray[np.float64],
    normals: NDArray[np.float64] | None,
    directions: NDArray[np.float64],
) -> NDArray[np.float32]:
    """[n, m, 4] what is first met from `points` [n, 3] (volume metres): radiance (RGB) and distance in metres.

    The distance is positive for photographed surface, negative for a surface's back or one without a colour, and 0
    where nothing is met. directions: [sets, m, 3] unit, world axes; point i takes set i modulo sets. normals: [n, 3],
    directions below their plane are skipped (0); None: of none.
    """
    buffers, (sets, per_set, _) = engine.buffers(_Buffers), directions.shape
    planes = np.zeros((len(points), 4)) if normals is None else np.pad(normals, ((0, 0), (0, 1)), constant_values=1.0)
    arrivals = buffers.arrivals.array((len(points), per_set))
    engine.launch(
        engine.kernel("arrivals.cl", "trace_arrivals", LANES=engine.lanes),
        (-(-per_set // engine.lanes), len(points)),
        *volume.arguments(),
        volume.colors,
        len(points),
        per_set,
        sets,
        buffers.points.upload(_padded(points)),
        buffers.normals.upload(planes.astype(np.float32).view(cl_types.float4)[:, 0]),
        buffers.directions.upload(_padded(directions)),
        arrivals,
    )
    result: NDArray[np.float32] = engine.download(arrivals).view(np.float32).reshape(len(points), per_set, 4)
    return result


def _padded(vectors: NDArray[np.float64]) -> NDArray[np.void]:
    """[...] float4 of [..., 3]."""
    padded: NDArray[np.float32] = np.zeros((*vectors.shape[:-1], 4), np.float32)
    padded[..., :3] = vectors
    return padded.view(cl_types.float4)[..., 0]
