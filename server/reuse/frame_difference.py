"""Differences of a frame from the mean of the frames before it, per tile, in codes. Kernel: frame_difference.cl."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pyopencl.array as cl_array
import pyopencl.cltypes as cl_types
from numpy.typing import NDArray

from server.opencl.buffers import BufferDescription, StageBuffers
from server.opencl.engine import Engine
from server.opencl.transfer import fill_bytes

TILE = 8
"""Pixels along a side of a tile, as in the kernel."""

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Differences:
    """Per tile, [tiles] float64."""

    mean: Floats
    """Mean of the frame's codes minus those of the mean picture."""
    mean_square: Floats
    """Mean square of the same difference."""
    count: Floats
    """Values that are valid in both; where it is 0 the means are 0."""
    flipped: Floats
    """Values that are valid in one of the two only: depth that appears or vanishes."""
    cols: int
    """Tiles in a row."""


class _Buffers(StageBuffers):
    codes = BufferDescription(np.uint8)
    wide_codes = BufferDescription(np.uint16)
    """The picture that is compared, of 8 or 16 bits."""
    mean = BufferDescription(np.float32)
    sums = BufferDescription(cl_types.float4)
    """[tile rows, tile columns] sums of differences, of their squares, and counts."""


class MeanPicture:
    """Running mean of pictures [h, w, 3], or of depth [h, w] in which 0 and 65535 are invalid; uint8 or uint16."""

    def __init__(self, engine: Engine) -> None:
        self._engine, self._buffers = engine, _Buffers(engine.workspace)
        self.frames = 0

    def forget(self) -> None:
        """Start again."""
        self.frames = 0

    def upload(self, codes: NDArray[np.uint8] | NDArray[np.uint16]) -> cl_array.Array:
        """The picture on the device."""
        buffers = self._buffers
        return (buffers.wide_codes if codes.dtype == np.uint16 else buffers.codes).upload(codes)

    def compare(self, codes: cl_array.Array) -> Differences:
        """Differences of an uploaded picture, of the same size as those before. Waits for the device."""
        engine, (height, width) = self._engine, codes.shape[:2]
        cols, rows = -(-width // TILE), -(-height // TILE)
        sums = self._buffers.sums.array((rows, cols))
        kernel = engine.kernel("frame_difference.cl", "compare_codes", **_defines(codes))
        engine.launch(kernel, (cols, rows), width, height, cols, rows, codes, self._mean(codes), sums)
        found = engine.download(sums).view(np.float32).reshape(-1, 4).astype(np.float64)
        known = np.maximum(found[:, 2], 1.0)
        return Differences(found[:, 0] / known, found[:, 1] / known, found[:, 2], found[:, 3], cols)

    def add(self, codes: cl_array.Array) -> None:
        """Fold an uploaded picture in."""
        self.frames += 1
        mean = self._mean(codes)
        if self.frames == 1:
            fill_bytes(self._engine.queue, mean, 0)
        kernel = self._engine.kernel("frame_difference.cl", "average_codes", **_defines(codes))
        self._engine.launch(kernel, (codes.size,), codes.size, self.frames, codes, mean)

    def _mean(self, codes: cl_array.Array) -> cl_array.Array:
        return self._buffers.mean.array(codes.shape)


def _defines(codes: cl_array.Array) -> dict[str, int]:
    channels = codes.shape[2] if len(codes.shape) > 2 else 1
    return {"CHANNELS": channels} | ({"WIDE": 1} if codes.dtype == np.uint16 else {})
