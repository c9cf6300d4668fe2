"""Scenes of `probeless tune`: synthetic, with exactly known light and composites.

The time of an operating point is measured with the default options of `probeless run` and two virtual objects in view.
The light error is measured as in thesis 5.3.1: pictures are replaced by the reconstructed geometry with one albedo
under a known light, so the error is due to sampling only. Each frame has another light and uses no earlier frames.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from statistics import median
from tempfile import TemporaryDirectory

import numpy as np
from msgspec import structs
from numpy.typing import NDArray

from client.objects.object_file import ObjectFile
from client.objects.placing import place_objects
from client.sources.volume import default_volume, default_voxel
from client.synthetic.export import write_guests
from client.synthetic.lighting.lights import disc_light
from client.synthetic.source import SyntheticSource, open_synthetic
from client.tuning.known_light import LitFrame, estimated_lights, moving_light, shaded_views
from protocol.messages import Wishes
from server.client_session import ClientSession
from server.maths.light_direction import direction_error_deg
from server.maths.sh import spherical_fibonacci
from server.opencl.device import Device
from server.pipeline import FrameResult
from server.quality.costs import rows_of
from server.quality.sampling_settings import SamplingSettings
from server.shading.composite import srgb_codes

Progress = Callable[[int], None]
"""Called with the number of processed frames of an operating point."""
SIZE = "640x480"
LIT_SIZE = "480x360"
FRAMES, SETTLING = 15, 3
"""Frames of the stage, and how many are not measured, as they compile kernels and allocate arrays."""
LIT_FRAMES, LIT_SETTLING = 34, 2  # medians of 10 lights differ by 2 degrees, which is more than points do
_STEP = 2  # frames of the camera path between pictures, about a tenth of a second of walking
_WALK = 240
_LEAST_HEIGHT = 0.3


@dataclass(frozen=True)
class Cost:
    """Cost of one operating point."""

    ms: dict[str, float]
    """Median time of a frame, by row of the timings and `other`."""
    picture_error: float
    """Mean difference from the true composite where objects change it, in display units."""


class Stage:
    """The stage set with two objects, virtual in the pipeline and real in the ground truth."""

    def __init__(self) -> None:
        spec = f"synthetic:stage?size={SIZE}&frames={FRAMES}&texture=market&light=7"
        self.source = open_synthetic(spec)
        self._guests = open_synthetic(f"{spec}&with=both")
        self._frames = [self.source[i] for i in range(FRAMES)]
        bare = [srgb_codes(self.source.truth(i).radiance) for i in range(FRAMES)]
        self._composites = [srgb_codes(self._guests.truth(i).radiance) for i in range(FRAMES)]
        self._changed = [(a != b).any(axis=-1) for a, b in zip(self._composites, bare, strict=True)]

    def cost(self, device: Device, point: SamplingSettings, progress: Progress) -> Cost:
        """Run the frames at an operating point."""
        found = self._results(device, point, progress)
        rows = [rows_of(result.timings) for result in found[SETTLING:]]
        errors = [self._difference(i, found[i].color) for i in range(SETTLING, FRAMES)]
        return Cost({name: median(row[name] for row in rows) for name in rows[0]}, median(errors))

    def _results(self, device: Device, point: SamplingSettings, progress: Progress) -> list[FrameResult]:
        pipeline = ClientSession(device, self.source.camera, point.wishes(_usual(self.source)))
        found: list[FrameResult] = []
        try:
            with TemporaryDirectory() as folder:
                objects = tuple(ObjectFile(path, None) for path in write_guests(Path(folder), self._guests))
                place_objects(pipeline, objects, lambda _: None)
            for frame in self._frames:
                found.append(pipeline.process(frame))
                progress(len(found))
        finally:
            pipeline.close()
        return found

    def _difference(self, index: int, shown: NDArray[np.uint8] | None) -> float:
        assert shown is not None  # `Wishes.answer` is picture
        mask = self._changed[index]
        return float(np.abs(shown[mask].astype(np.float64) - self._composites[index][mask]).mean())


class LitRoom:
    """The room, every frame under another known light; of one albedo, so that what errs is sampling."""

    def __init__(self, device: Device, progress: Progress) -> None:
        self._source = open_synthetic(f"synthetic:room?size={LIT_SIZE}&frames={_WALK}&noise=1&texture=0")
        self._wishes = structs.replace(
            _usual(self._source), albedo="constant", indirect="none", robustness=("openness", "outliers")
        )
        frames = (self._source[_STEP * i] for i in range(LIT_FRAMES))
        assert self._wishes.volume_m is not None
        assert self._wishes.voxel_m is not None
        views = shaded_views(device, self._source.camera, frames, self._wishes.volume_m, self._wishes.voxel_m)
        self._frames: list[LitFrame] = []
        for frame in moving_light(views, _light_of):
            self._frames.append(frame)
            progress(len(self._frames))

    def error_deg(self, device: Device, point: SamplingSettings, progress: Progress) -> float:
        """Error of the dominant direction, median over frames."""
        lights = estimated_lights(device, self._source.camera, self._frames, point.wishes(self._wishes))
        errors: list[float] = []
        for frame, found in lights:
            errors.append(direction_error_deg(found, frame.sh))
            progress(len(errors))
        return median(errors[LIT_SETTLING:])


def _usual(source: SyntheticSource) -> Wishes:
    volume_m = default_volume(source, range(len(source)))
    return Wishes(volume_m=volume_m, voxel_m=default_voxel(volume_m), up=source.up)


def _light_of(index: int) -> NDArray[np.float64]:
    """[16, 3] light from above, with another direction in each frame."""
    sides = spherical_fibonacci(2 * LIT_FRAMES)
    x, y, z = sides[index // _STEP]
    toward = np.array([x, max(abs(z), _LEAST_HEIGHT), y])  # y is up in the room
    return disc_light(toward / np.linalg.norm(toward)).sh
