"""Tone mapping (thesis 7.1, H of eq. 7.1-7.2): how bright virtual objects are beside the camera's picture.

H scales shading so that a surface of the assumed albedo is on average as bright as the picture. This is right only if
the unclipped surface in view has the assumed albedo on average: picture = albedo x R, so the gain is mean albedo /
assumed albedo, whatever the light. In two path-traced rooms under the true light it is 0.56 and 0.88, and objects have
0.53 and 0.84 of their true brightness; by the scale of the light they have 0.96 and 0.95 (medians over frames). So the
scale of the light is the default, and H is the thesis's. Real surface needs no scale: it cancels in R' / R.
Kernel: tone_mapping.cl.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pyopencl.array as cl_array
import pyopencl.cltypes as cl_types

from protocol.frames import CameraModel
from server.light.light_estimation import ASSUMED_ALBEDO, FORGETTING
from server.opencl.buffers import BufferDescription, StageBuffers
from server.opencl.engine import Engine
from server.shading.traced_scene import DeviceLight, light_arguments
from server.transfer.indirect import Indirect, no_hits
from server.transfer.radiance_transfer import Directions, Transfer, sample_arguments, sample_grid
from server.volume.raycast import Surface

EVERY = 3
"""Every EVERY-th sample along each axis is used. An odd number, so that all direction sets contribute."""
LEAST_LUMINANCE = 1e-4
"""Averages below this are not used. The picture's white is 1."""


class _Buffers(StageBuffers):
    pairs = BufferDescription(cl_types.float4)
    """[rows, cols]: luminance of the picture, of the shading, whether the sample is usable, unused."""
    row_sums = BufferDescription(cl_types.float4)
    """[rows]: the pairs of a row, added."""


@dataclass(frozen=True)
class Averages:
    """Mean luminances over the usable samples of real surface."""

    picture: float
    shading: float
    """R, of white surface without virtual objects."""
    samples: int

    @property
    def are_known(self) -> bool:
        """Whether there is something to match: neither buffer is empty or black."""
        return self.samples > 0 and min(self.picture, self.shading) > LEAST_LUMINANCE

    @property
    def gain(self) -> float:
        """What brings shading to the picture's units; 1, the light's own scale, where the averages are not known."""
        return self.picture / (ASSUMED_ALBEDO * self.shading) if self.are_known else 1.0


class AverageMemory:
    """A session's averages, over its last frames: what comes into the picture must not make brightness jump."""

    def __init__(self) -> None:
        self._picture = self._shading = self._weight = 0.0
        self._samples = 0

    def update(self, frame: Averages, exposure: float) -> Averages:
        """The averages with one more frame at `exposure`. A frame without usable samples changes nothing."""
        if frame.are_known:
            self._picture = FORGETTING * self._picture + frame.picture / exposure
            self._shading = FORGETTING * self._shading + frame.shading / exposure
            self._weight = FORGETTING * self._weight + 1.0
            self._samples = frame.samples
        scale = exposure / max(self._weight, 1.0)
        return Averages(scale * self._picture, scale * self._shading, self._samples)


def measure_averages(
    engine: Engine,
    camera: CameraModel,
    radiance: cl_array.Array,
    surface: Surface,
    transfer: Transfer,
    rays: Directions,
    light: DeviceLight,
    indirect: Indirect | None,
    ray_length_m: float,
) -> Averages:
    """Averages of one frame. radiance: [h, w] float4 as in Measurement; indirect: radiance from surfaces, None: 0."""
    cols, rows = -(-transfer.cols // EVERY), -(-transfer.rows // EVERY)
    buffers = engine.buffers(_Buffers)
    pairs = buffers.pairs.array((rows, cols))
    words = transfer.free_mask.shape[2]
    defines = {"BANDS": transfer.bands, "MASK_WORDS": words, "LANES": engine.lanes, "INTERLEAVE": transfer.interleave}
    engine.launch(
        engine.kernel("tone_mapping.cl", "shade_pairs", **defines),
        (cols, rows),
        sample_grid(camera, transfer),
        *sample_arguments(engine, surface, transfer),
        radiance,
        transfer.coefficients,
        indirect.hits if indirect else no_hits(engine, transfer),
        *light_arguments(engine, light, rays, ray_length_m),
        EVERY,
        cols,
        rows,
        pairs,
    )
    sums = buffers.row_sums.array((rows,))
    engine.launch(engine.kernel("tone_mapping.cl", "sum_rows", **defines), (rows,), cols, rows, pairs, sums)
    total = engine.download(sums).view(np.float32).reshape(-1, 4).sum(axis=0, dtype=np.float64)
    count = int(total[2])
    return Averages(float(total[0]) / max(count, 1), float(total[1]) / max(count, 1), count)
