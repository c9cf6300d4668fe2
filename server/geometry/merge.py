"""The hybrid geometry buffer (thesis 4.2.2, eq. 4.1-4.5): the volume's surface merged with the measured depth.

Kernels: merge.cl, geometry_buffer.cl. Three passes compute the depth: D' takes the volume where the sensor agrees with
it and the sensor elsewhere, and fills the sensor's holes; D'' is a joint bilateral median, D''' a median. Choices that
the thesis leaves open:

- lambda_D, the difference of depths that agree: 1.5 voxels plus four deviations of the sensor's noise (agreement.clh).
- lambda_I: LAMBDA_INTENSITY. k: 17 pixels for holes (a hole up to 16 pixels wide is filled), 5 for D'', 3 for D'''.
- Where the volume is unknown, the sensor's depth is used. A hole with too few supporting neighbours (LEAST_SUPPORT in
  merge.cl) keeps the volume's surface; without one it stays a hole.
- The median of an even count is the lower one. D'' and D''' fill no holes.
- D'' and D''' remove noise of the sensor. Where all known depth in their window is the volume's, they keep it: no
  filter runs where measured and fused depth agree.
- Where the final depth agrees with the volume, the volume's own surface is used, unfiltered: the medians would shift it
  by up to the slope across their windows, at most lambda_D.
"""

from __future__ import annotations

import numpy as np
import pyopencl.array as cl_array
from numpy.typing import NDArray

from protocol.frames import CameraModel
from server.input.measure import Measurement, intrinsics
from server.maths.rigid import inverse_rigid
from server.opencl.buffers import BufferDescription, BufferGroup, StageBuffers
from server.opencl.engine import Engine, KernelArgument, float16, int4
from server.volume.raycast import Surface, SurfaceBuffers
from server.volume.volume import Volume

LAMBDA_INTENSITY = 0.04
"""Greatest difference of intensities of one surface (eq. 4.1), in square roots of linear luminance, in which noise is
about the same at every brightness. Three deviations of a difference (times sqrt 2) at a deviation of 0.01: 2.5 codes
of 255, a camera's noise indoors; the JPEG pictures of the public data sets have 0.001 to 0.004."""

TRUSTED_WEIGHT = 15.0
"""Frames that must have seen a surface of the volume before it fills holes of the sensor, at most half of all frames.
A sparse volume does not store free space, so that a moving object becomes surface at once; in a hole of the sensor, as
beside a hand, only this number distinguishes it from the room."""

STILL_WEIGHT = 5.0
"""Frames that must have seen a surface before it counts as static, with the same limit: a moving object agrees with a
volume into which it was just fused."""

_BORDER = 8  # as in planes.clh


class _Buffers(StageBuffers):
    """Planes are [h + 2 _BORDER, pitch] metres, 0 = none, see include/planes.clh."""

    measured = BufferDescription(np.float32)
    """D_C."""
    predicted = BufferDescription(np.float32)
    """D_X."""
    shade = BufferDescription(np.float32)
    """Intensity: the square root of linear luminance."""
    sensed = BufferDescription(np.float32)
    """D_C, negative where it agrees with D_X, 0 where it mixes two surfaces."""
    merged = BufferDescription(np.float32)
    """D'; then D''', which does not read D'."""
    aligned = BufferDescription(np.float32)
    """D_X, negative where it may not fill holes, until D' is known; then D''."""
    surface = BufferGroup(SurfaceBuffers)

    def planes(self, shape: tuple[int, int]) -> tuple[cl_array.Array, ...]:
        """In the order in which lay_out of merge.cl takes them."""
        buffers = self.measured, self.predicted, self.shade, self.sensed, self.merged, self.aligned
        return tuple(buffer.array(shape) for buffer in buffers)


def merge_depth(
    engine: Engine,
    camera: CameraModel,
    volume_from_camera: NDArray[np.float64],
    measurement: Measurement,
    model: Surface,
    volume: Volume,
    smooth: bool = True,
) -> Surface:
    """The hybrid geometry buffer, in buffers of its own. Its colour is `measurement.radiance`, pixel by pixel.

    smooth: whether the median D''' is computed from D''.

    Labels: static: the volume's surface; dynamic: the sensor's depth, where it disagrees with the volume or the volume
    is unknown; filled: the median of neighbours; none: unknown.
    """
    merge = _Merge(engine, camera, volume_from_camera, model, volume)
    merge.lay_out(measurement)
    merge.compare()
    merge.merge()
    depth = merge.align()
    if smooth:
        depth = merge.smooth()
    return merge.geometry_buffer(depth)


class _Merge:
    """The steps of one frame, in order."""

    def __init__(
        self,
        engine: Engine,
        camera: CameraModel,
        volume_from_camera: NDArray[np.float64],
        model: Surface,
        volume: Volume,
    ) -> None:
        self._engine, self._camera, self._model, self._volume = engine, camera, model, volume
        self._volume_from_camera = volume_from_camera
        self._size = camera.width, camera.height
        self._groups = -(-camera.width // 8), camera.height
        self._bordered = 8 * self._groups[0] + 2 * _BORDER, camera.height + 2 * _BORDER
        self._surface_buffers = engine.buffers(_Buffers).surface
        self._planes = engine.buffers(_Buffers).planes(self._bordered[::-1])
        self._measured, self._predicted, self._shade, self._sensed, self._merged, self._aligned = self._planes

    def lay_out(self, measurement: Measurement) -> None:
        """Depth and intensity as planes."""
        self._launch(
            "merge.cl",
            "lay_out",
            self._bordered,
            measurement.depth_m,
            measurement.radiance,
            self._model.positions,
            float16(inverse_rigid(self._volume_from_camera)),
            *self._planes,
        )

    def compare(self) -> None:
        """Where sensor and volume agree (first and second case of eq. 4.3)."""
        volume = self._volume
        self._launch(
            "merge.cl",
            "compare_depth",
            self._groups,
            self._measured,
            self._predicted,
            self._model.positions,
            int4(*volume.bricks, 0),
            volume.slots_device,
            volume.voxels,
            volume.voxel_m,
            min(STILL_WEIGHT, volume.frames / 2),
            min(TRUSTED_WEIGHT, volume.frames / 2),
            self._aligned,
            self._sensed,
        )

    def merge(self) -> None:
        """D' (eq. 4.3)."""
        planes = self._sensed, self._aligned, self._shade
        lambdas = self._volume.voxel_m, LAMBDA_INTENSITY
        self._launch("merge.cl", "merge_depth", self._groups, *planes, *lambdas, self._merged)

    def align(self) -> cl_array.Array:
        """D'' (eq. 4.4)."""
        planes = self._merged, self._predicted, self._shade
        self._launch("merge.cl", "align_depth", self._groups, *planes, LAMBDA_INTENSITY, self._aligned)
        return self._aligned

    def smooth(self) -> cl_array.Array:
        """D''' (eq. 4.5)."""
        self._launch("merge.cl", "smooth_depth", self._groups, self._aligned, self._predicted, self._merged)
        return self._merged

    def geometry_buffer(self, depth: cl_array.Array) -> Surface:
        """Positions, normals and labels of a plane of depth."""
        buffers, shape, model = self._surface_buffers, self._size[::-1], self._model
        surface = Surface(buffers.positions.array(shape), buffers.normals.array(shape), buffers.labels.array(shape))
        self._launch(
            "geometry_buffer.cl",
            "geometry_buffer",
            self._groups,
            depth,
            self._sensed,
            self._predicted,
            intrinsics(self._camera),
            float16(self._volume_from_camera),
            self._volume.voxel_m,
            model.positions,
            model.normals,
            surface.positions,
            surface.normals,
            surface.labels,
        )
        return surface

    def _launch(self, file: str, name: str, items: tuple[int, int], *arguments: KernelArgument) -> None:
        self._engine.launch(self._engine.kernel(file, name), items, *self._size, self._bordered[0], *arguments)
