"""E1 (thesis 5.3.1, 6.1.3): reconstructed geometry under a known light replaces the camera's picture.

The picture shows the hybrid geometry buffer, all of one albedo, shaded through a transfer of its own with more rays
than any estimator uses, so that sampling, the 8-bit picture and the estimator are tested, not the reconstruction.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from protocol.frames import CameraModel, RgbdFrame
from protocol.messages import Wishes
from server.client_session import ClientSession
from server.evaluation.environment import direction_dot, direction_error_deg, environment_difference
from server.geometry.geometry import Geometry
from server.opencl.device import Device
from server.opencl.engine import Engine
from server.quality.settings import WHOLE_ROOM_M
from server.shading.composite import srgb_codes
from server.transfer.radiance_transfer import Transfer, direction_sets, transfer_radiance
from server.volume.bounds import Bounds

Floats = NDArray[np.float64]

ALBEDO = 0.5
"""Of everything in the picture."""
RAYS = 243
"""Directions that the picture is shaded from: three times the estimator's, and from a lattice of its own."""
BACKGROUND = 0.25
"""Linear grey where there is no surface."""


@dataclass(frozen=True)
class LitFrame:
    """A frame whose picture shows a known light."""

    frame: RgbdFrame
    sh: Floats
    """[16, 3] the light, in the units of the linearised picture."""


@dataclass(frozen=True)
class ShadedView:
    """What is needed to shade one frame under any light."""

    frame: RgbdFrame
    transfer: Floats
    """[h, w, 16] float32."""
    covered: NDArray[np.bool_]
    """[h, w] there is surface."""

    def under(self, sh: Floats, albedo: Floats | float = ALBEDO) -> Floats:
        """[h, w, 3] linear radiance under a light [16, 3]; `albedo`: a number or [h, w, 3]."""
        shading = np.maximum(self.transfer.astype(np.float64) @ sh, 0)
        return np.where(self.covered[..., None], albedo * shading, BACKGROUND)

    def lit(self, sh: Floats, albedo: Floats | float = ALBEDO) -> LitFrame:
        """The frame as a camera would see it, 8-bit sRGB."""
        return LitFrame(replace(self.frame, color=srgb_codes(self.under(sh, albedo))), sh)


@dataclass
class Score:
    """How well one operating point did, a figure a frame."""

    dots: list[float] = field(default_factory=list)
    """Dot product of dominant directions."""
    differences: list[float] = field(default_factory=list)
    """Of environment maps, relative."""
    lights: list[Floats] = field(default_factory=list)
    """[16, 3] as found."""


def shaded_views(
    device: Device,
    camera: CameraModel,
    frames: Iterable[RgbdFrame],
    volume_m: Bounds,
    voxel_m: float,
    rays: int = RAYS,
) -> Iterator[ShadedView]:
    """Fuse `frames` one after the other; after each, the transfer of what the hybrid buffer then shows."""
    engine = Engine(device)
    geometry = Geometry(engine, camera, Wishes(volume_m=volume_m, voxel_m=voxel_m))
    directions = direction_sets(rays, 4)
    for frame in frames:
        surface = geometry.scan(frame).surface
        assert geometry.volume is not None
        transfer = transfer_radiance(engine, camera, geometry.volume, surface, 1, directions, WHOLE_ROOM_M)
        yield _view(engine, frame, transfer)
    engine.close()


def _view(engine: Engine, frame: RgbdFrame, transfer: Transfer) -> ShadedView:
    covered = engine.download(transfer.openness) >= 0
    return ShadedView(frame, engine.download(transfer.coefficients), covered)


def moving_light(views: Iterable[ShadedView], light: Callable[[int], Floats]) -> Iterator[LitFrame]:
    """Each frame under the light [16, 3] of its number."""
    for view in views:
        yield view.lit(light(view.frame.index))


def score(device: Device, camera: CameraModel, frames: Iterable[LitFrame], wishes: Wishes) -> Score:
    """Run the pipeline over `frames`. Raises ValueError for wishes that it cannot fulfil."""
    pipeline = ClientSession(device, camera, wishes)
    result = Score()
    for item in frames:
        answer = pipeline.process(item.frame)
        found = np.array(answer.light.sh)
        result.dots.append(direction_dot(found, item.sh))
        result.differences.append(environment_difference(found, item.sh))
        result.lights.append(found)
    pipeline.close()
    return result


def lag_of(found: Sequence[Floats], true: Sequence[Floats], most: int) -> tuple[int, float]:
    """By how many frames, `most` at the most, estimates [16, 3] follow a moving light; the mean angle left, degrees.

    What is left at that lag is not lateness. Raises ValueError where there are not more than `most` frames.
    """
    frames = range(most, len(found))
    if not frames:
        raise ValueError(f"{len(found)} frames do not show a lag of {most}")
    angles = [
        float(np.mean([direction_error_deg(found[t], true[t - late]) for t in frames])) for late in range(most + 1)
    ]
    best = int(np.argmin(angles))
    return best, angles[best]
