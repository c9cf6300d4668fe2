"""Values on a regular subset of an image's pixels."""

from __future__ import annotations

from dataclasses import dataclass

import pyopencl.array as cl_array


@dataclass(frozen=True)
class SampleGrid:
    """Values at samples every `stride` pixels, [rows, cols] float4; w = 1 valid."""

    stride: int
    values: cl_array.Array

    @property
    def rows(self) -> int:
        """Samples down."""
        return int(self.values.shape[0])

    @property
    def cols(self) -> int:
        """Samples across."""
        return int(self.values.shape[1])
