"""Values on a regular subset of an image's pixels."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pyopencl.array as cl_array

from protocol.frames import CameraModel
from server.objects.pixel_boxes import PixelBox
from server.opencl.structs import GRID

NO_GRID = GRID(cols=0, rows=0, stride=1, width=0)
"""For kernels that shade no samples of a picture."""


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

    @property
    def all(self) -> PixelBox:
        """All samples: x0, y0, x1, y1, half-open."""
        return 0, 0, self.cols, self.rows

    def inside(self, box: PixelBox) -> PixelBox:
        """The samples at the pixels of `box`, and some beside it, as `all`."""
        x0, y0, x1, y1 = box
        return (
            x0 // self.stride,
            y0 // self.stride,
            min(-(-x1 // self.stride), self.cols),
            min(-(-y1 // self.stride), self.rows),
        )


def grid_of(samples: SampleGrid, camera: CameraModel) -> np.void:
    """GRID of samples of a camera's picture."""
    return GRID(cols=samples.cols, rows=samples.rows, stride=samples.stride, width=camera.width)


def pixel_grid(camera: CameraModel) -> np.void:
    """GRID whose samples are all pixels."""
    return GRID(cols=camera.width, rows=camera.height, stride=1, width=camera.width)


def no_samples(camera: CameraModel) -> np.void:
    """GRID without samples."""
    return GRID(cols=0, rows=0, stride=1, width=camera.width)
