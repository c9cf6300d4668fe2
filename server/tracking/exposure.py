"""Exposure of each picture relative to the session's first (B3): as the source gives it, else estimated as one factor.

Kernel: exposure.cl. The volume holds what surfaces send in the units of the first picture; a picture's factor is where
the ratios of its own brightness to that lie. A light change that is equal on all surfaces is treated as exposure: in
the units of the frame's own image, in which light is reported, both are the same.
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
from server.opencl.buffers import BufferDescription, DeviceBuffer, StageBuffers
from server.opencl.engine import Engine, float16, int4
from server.volume.volume import Volume

DEAD_BAND = 0.01
"""Of the logarithm, or a standard deviation where that is more: what registration and a camera's tone curve make of one
exposure. Nearer than this the last factor is kept to the last bit, beyond it is followed at this distance: a constant
exposure stays constant, and noise does not show."""
GREATEST_STEP = 64.0
"""Between two frames; a camera's whole range within a room is less."""
GREATEST_EXPOSURE = 1e6
"""Relative to the first frame, and one over it the least."""
LEAST_SAMPLES = 100
"""Fewer surface points seen again say nothing: the last factor is kept."""
LEAST_SHARE = 0.25
"""Of the samples that must agree on a factor."""
LEAST_OBSERVATIONS = 2.0
"""Pictures that must have seen a surface, or all of them while there are fewer."""
_MOST_SAMPLES = 2304
_LEAST_SCALE = 0.005
_GROUP_SAMPLES = 8  # to a side, of a part of the picture that shares its errors
_NOISE_FLOOR = 0.02  # luminance under which the noise of a camera is not in proportion to the root of it


class _Buffers(StageBuffers):
    samples = BufferDescription(cl_types.float4)
    """[rows, cols] as compare_exposure of exposure.cl writes them."""


@dataclass(frozen=True)
class Samples:
    """Surface seen before and seen again."""

    seen: NDArray[np.float64]
    """[n] luminance in the picture."""
    predicted: NDArray[np.float64]
    """[n] luminance that the volume has of it."""
    observations: NDArray[np.float64]
    """[n] pictures that the prediction is a mean of."""
    groups: NDArray[np.int64]
    """[n] number of the part of the picture."""

    def __len__(self) -> int:
        return len(self.seen)


def compare_exposure(
    engine: Engine,
    camera: CameraModel,
    measurement: Measurement,
    volume: Volume,
    volume_from_camera: NDArray[np.float64],
) -> Samples:
    """What a picture, not yet integrated, shows again of surface that the volume has a colour of."""
    stride = max(1, math.ceil(math.sqrt(camera.width * camera.height / _MOST_SAMPLES)))
    shape = (camera.height // stride, camera.width // stride)
    samples = engine.buffers(_Buffers).samples.array(shape)
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
    """Logarithm of the picture's exposure; None where too little was seen again. last: of the frame before."""
    if len(samples) < LEAST_SAMPLES:
        return None
    ratios = np.log(samples.seen / samples.predicted)
    # A camera's noise goes about with the root of what it sees; its part of a mean of n looks is one in n.
    brightness = samples.predicted * math.exp(last)
    weights = brightness / (brightness + _NOISE_FLOOR) * samples.observations / (samples.observations + 1)
    found = robust_location(ratios, weights, samples.groups, last, _LEAST_SCALE)
    return found if found.share >= LEAST_SHARE else None


def followed(last: float, found: Location) -> float:
    """The logarithm to go on with: `last` where what was found does not contradict it."""
    band = max(DEAD_BAND, found.std)
    return min(max(last, found.value - band), found.value + band)


def scene_radiance(engine: Engine, radiance: cl_array.Array, exposure: float, buffer: DeviceBuffer) -> cl_array.Array:
    """[h, w] float4: a picture's radiance, as in Measurement, in the units of the first picture; `radiance` itself for
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
    """Exposures of one camera's frames, one after the other; that of the first one in the volume is 1."""

    def __init__(self, engine: Engine, camera: CameraModel, mode: Literal["auto", "constant"]) -> None:
        self._engine = engine
        self._camera = camera
        self._mode = mode
        self._exposure: float | None = None
        self._given_of_first: float | None = None
        """What the source would have said of the first frame."""

    def update(
        self,
        frame: RgbdFrame,
        measurement: Measurement,
        volume: Volume,
        volume_from_camera: NDArray[np.float64] | None,
    ) -> tuple[float, tuple[str, ...]]:
        """Exposure of a frame before it is integrated, and what was wrong with the one it came with, one line each.

        volume_from_camera: None where it is not known, and nothing can be compared.
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
        """A given exposure, None for one that cannot be; and why."""
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
                f"the frame's exposure of {given:g} is {step:.3g} times another than the last frame's, which no camera "
                "does: it is estimated",
            )
        return given, ()
