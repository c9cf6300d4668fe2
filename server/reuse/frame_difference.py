"""What a frame differs by from the mean of those before it, tile by tile, in codes. Kernel: frame_difference.cl."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pyopencl.array as cl_array
import pyopencl.cltypes as cl_types
from numpy.typing import NDArray

from server.opencl.engine import Engine
from server.opencl.transfer import fill_bytes

TILE = 8
"""Pixels to a side, as in the kernel."""

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Differences:
    """Of each tile, [tiles] float64."""

    mean: Floats
    """Codes of this frame less those of the mean."""
    mean_square: Floats
    """Of the same."""
    count: Floats
    """Numbers that are known to both; 0 leaves the means at 0."""
    flipped: Floats
    """Numbers that are known to one of the two alone: depth that comes and goes."""
    cols: int
    """Tiles in a row."""


class MeanPicture:
    """The running mean of pictures [h, w, 3], or of depth [h, w], of which 0 and 65535 are unknown; uint8 or uint16."""

    def __init__(self, engine: Engine, name: str) -> None:
        """`name` of its arrays in the engine's workspace."""
        self._engine = engine
        self._name = name
        self.frames = 0

    def forget(self) -> None:
        """Begin anew."""
        self.frames = 0

    def upload(self, codes: NDArray[np.uint8] | NDArray[np.uint16]) -> cl_array.Array:
        """The picture on the device."""
        return self._engine.workspace.upload(f"{self._name}_codes", codes)

    def compare(self, codes: cl_array.Array) -> Differences:
        """What an uploaded picture differs by, which is of the size of those before. Waits for the device."""
        engine, (height, width) = self._engine, codes.shape[:2]
        cols, rows = -(-width // TILE), -(-height // TILE)
        sums = engine.workspace.array(f"{self._name}_sums", (rows, cols), cl_types.float4)
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
        return self._engine.workspace.array(f"{self._name}_mean", codes.shape, np.float32)


def _defines(codes: cl_array.Array) -> dict[str, int]:
    channels = codes.shape[2] if len(codes.shape) > 2 else 1
    return {"CHANNELS": channels} | ({"WIDE": 1} if codes.dtype == np.uint16 else {})
