"""Exposure of each picture relative to the session's first (B3): given by the source, or estimated as one factor.

Kernel: exposure.cl. The volume stores radiance in the units of the first picture; the exposure is a robust location of
the ratios between the picture and the volume. A light change that is equal on all surfaces is treated as exposure:
light is reported in the units of the frame's own image, where both are the same.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

import numpy as np
import pyopencl.array as cl_array
import pyopencl.cltypes as cl_types
from numpy.typing import NDArray

from protocol.frames import CameraModel, RgbdFrame
from server.input.measure import Measurement, intrinsics
from server.maths.robust_location import Location, robust_location
from server.opencl.buffers import DeviceBuffer
from server.opencl.engine import Engine, float16, int4
from server.volume.volume import Volume

DEAD_BAND = 0.01
"""Dead band of the logarithm (or one standard deviation, if greater): errors of registration and of a camera's tone
curve. Within it the last factor is kept exactly; beyond it the factor follows at this distance. So a constant exposure
stays constant."""
GREATEST_STEP = 64.0
"""Greatest factor between two frames; a camera's range within a room is less."""
GREATEST_EXPOSURE = 1e6
"""Greatest exposure relative to the first frame; the least is its inverse."""
LEAST_SAMPLES = 100
"""With fewer surface points in common the last factor is kept."""
LEAST_SHARE = 0.25
"""Least share of the samples that must agree on a factor."""
LEAST_OBSERVATIONS = 2.0
"""Least number of pictures that must have seen a surface, or all pictures if there are fewer."""
_MOST_SAMPLES = 2304
_LEAST_SCALE = 0.005
_GROUP_SAMPLES = 8  # per side of a block of samples with common errors
_NOISE_FLOOR = 0.02  # luminance below which a camera's noise is not proportional to its root


@dataclass(frozen=True)
class Samples:
    """Surface that both the picture and the volume show."""

    seen: NDArray[np.float64]
    """[n] luminance in the picture."""
    predicted: NDArray[np.float64]
    """[n] luminance in the volume."""
    observations: NDArray[np.float64]
    """[n] observations that `predicted` is a mean of."""
    groups: NDArray[np.int64]
    """[n] number of the block of samples."""

    def __len__(self) -> int:
        return len(self.seen)


def compare_exposure(
    engine: Engine,
    camera: CameraModel,
    measurement: Measurement,
    volume: Volume,
    volume_from_camera: NDArray[np.float64],
) -> Samples:
    """Compare a picture, before it is integrated, with the volume's colours."""
    stride = max(1, math.ceil(math.sqrt(camera.width * camera.height / _MOST_SAMPLES)))
    shape = (camera.height // stride, camera.width // stride)
    samples = engine.array_to_read(shape, cl_types.float4)
    engine.launch(
        engine.kernel("exposure.cl", "compare_exposure"),
        shape[::-1],
        *shape[::-1],
        stride,
        camera.width,
        camera.height,
        measurement.radiance,
        measurement.depth_m,
        intrinsics(camera),
        float16(volume_from_camera),
        int4(*volume.bricks, 0),
        volume.slots_device,
        volume.voxels,
        volume.colors,
        volume.voxel_m,
        volume.truncation_m,
        min(LEAST_OBSERVATIONS, float(volume.frames)),
        samples,
    )
    found = engine.download(samples).view(np.float32).reshape(-1, 4).astype(np.float64)
    used = np.flatnonzero(found[:, 0] > 0)
    parts_across = -(-shape[1] // _GROUP_SAMPLES)
    groups = used // shape[1] // _GROUP_SAMPLES * parts_across + used % shape[1] // _GROUP_SAMPLES
    return Samples(found[used, 0], found[used, 1], found[used, 2], groups)


def locate_exposure(samples: Samples, last: float) -> Location | None:
    """Logarithm of the picture's exposure; None with too few samples in common. last: that of the frame before."""
    if len(samples) < LEAST_SAMPLES:
        return None
    ratios = np.log(samples.seen / samples.predicted)
    # A camera's variance is proportional to luminance; that of a mean of n observations is 1 / n of it.
    brightness = samples.predicted * math.exp(last)
    weights = brightness / (brightness + _NOISE_FLOOR) * samples.observations / (samples.observations + 1)
    found = robust_location(ratios, weights, samples.groups, last, _LEAST_SCALE)
    return found if found.share >= LEAST_SHARE else None


def followed(last: float, found: Location) -> float:
    """The next logarithm: `last` if the measured one does not contradict it."""
    band = max(DEAD_BAND, found.std)
    return min(max(last, found.value - band), found.value + band)


def scene_radiance(engine: Engine, radiance: cl_array.Array, exposure: float, buffer: DeviceBuffer) -> cl_array.Array:
    """[h, w] float4: a picture's radiance, as in Measurement, in the units of the first picture; `radiance` itself at
    exposure 1. Clipped pixels are marked AT_LEAST (include/radiance_marks.clh). `buffer` (float4) holds the result.
    """
    if exposure == 1.0:
        return radiance
    scene = buffer.array(radiance.shape)
    engine.launch(
        engine.kernel("exposure.cl", "scale_radiance"),
        (scene.size,),
        scene.size,
        1.0 / exposure,
        radiance,
        scene,
    )
    return scene


class ExposureTracking:
    """Exposures of one camera's frames in order; that of the first integrated frame is 1."""

    def __init__(self, engine: Engine, camera: CameraModel, mode: Literal["auto", "constant"]) -> None:
        self._engine = engine
        self._camera = camera
        self._mode = mode
        self._exposure: float | None = None
        self._given_of_first: float | None = None
        """Exposure of the first frame in the source's units."""

    def update(
        self,
        frame: RgbdFrame,
        measurement: Measurement,
        volume: Volume,
        volume_from_camera: NDArray[np.float64] | None,
    ) -> tuple[float, tuple[str, ...]]:
        """Exposure of a frame before it is integrated, and notes, one line each, if the given exposure is invalid.

        volume_from_camera: None if it is not known; then nothing is compared.
        """
        if self._mode == "constant":
            return 1.0, ()
        given, notes = self._checked(frame.exposure)
        if given is not None and self._given_of_first is not None:
            self._exposure = given / self._given_of_first
            return self._exposure, notes
        exposure = 1.0 if self._exposure is None else self._exposure
        if volume_from_camera is not None and volume.frames > 0:
            exposure = self._estimated(exposure, measurement, volume, volume_from_camera)
        if given is not None:
            self._given_of_first = given / exposure
        self._exposure = exposure
        return exposure, notes

    def _estimated(
        self, last: float, measurement: Measurement, volume: Volume, volume_from_camera: NDArray[np.float64]
    ) -> float:
        samples = compare_exposure(self._engine, self._camera, measurement, volume, volume_from_camera)
        found = locate_exposure(samples, math.log(last))
        logarithm = math.log(last) if found is None else followed(math.log(last), found)
        if logarithm == math.log(last) or abs(logarithm) > math.log(GREATEST_EXPOSURE):
            return last
        return math.exp(logarithm)

    def _checked(self, given: float | None) -> tuple[float | None, tuple[str, ...]]:
        """A given exposure, or None and a note if it is invalid."""
        if given is None:
            return None, ()
        if not (math.isfinite(given) and given > 0):
            return None, (f"the frame's exposure is {given:g}, not a positive number: it is estimated",)
        if self._given_of_first is None or self._exposure is None:
            return given, ()
        relative = given / self._given_of_first
        step = max(relative / self._exposure, self._exposure / relative) if relative > 0 else math.inf
        if step > GREATEST_STEP or not 1 / GREATEST_EXPOSURE <= relative <= GREATEST_EXPOSURE:
            return None, (
                f"the frame's exposure of {given:g} differs from the last frame's by a factor of {step:.3g}, more than "
                "a camera's range: it is estimated",
            )
        return given, ()
