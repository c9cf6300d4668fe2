"""E1 (thesis 5.3.1, 6.1.3): the camera's picture is replaced by reconstructed geometry under a known light.

The picture shows the hybrid geometry buffer with one albedo, shaded with more rays than any estimator uses. This tests
sampling, 8-bit quantisation and the estimator, but not the reconstruction.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from protocol.frames import CameraModel, RgbdFrame
from protocol.messages import Wishes
from server.client_session import ClientSession
from server.geometry.geometry import Geometry
from server.opencl.device import Device
from server.opencl.engine import Engine
from server.quality.settings import WHOLE_ROOM_M
from server.shading.composite import srgb_codes
from server.transfer.radiance_transfer import Transfer, direction_sets, transfer_radiance
from server.volume.bounds import Bounds

Floats = NDArray[np.float64]

ALBEDO = 0.5
"""Albedo of all surfaces."""
RAYS = 243
"""Directions for shading the picture: three times those of the estimator, in another lattice."""
BACKGROUND = 0.25
"""Linear grey of pixels without surface."""


@dataclass(frozen=True)
class LitFrame:
    """A frame under a known light."""

    frame: RgbdFrame
    sh: Floats
    """[16, 3] the light, in units of the linear picture."""


@dataclass(frozen=True)
class ShadedView:
    """A frame with its transfer, to shade it under any light."""

    frame: RgbdFrame
    transfer: Floats
    """[h, w, 16] float32."""
    covered: NDArray[np.bool_]
    """[h, w] pixels with surface."""

    def under(self, sh: Floats, albedo: Floats | float = ALBEDO) -> Floats:
        """[h, w, 3] linear radiance under a light [16, 3]; `albedo`: scalar or [h, w, 3]."""
        shading = np.maximum(self.transfer.astype(np.float64) @ sh, 0)
        return np.where(self.covered[..., None], albedo * shading, BACKGROUND)

    def lit(self, sh: Floats, albedo: Floats | float = ALBEDO) -> LitFrame:
        """The frame under a light [16, 3], in 8-bit sRGB."""
        return LitFrame(replace(self.frame, color=srgb_codes(self.under(sh, albedo))), sh)


def shaded_views(
    device: Device,
    camera: CameraModel,
    frames: Iterable[RgbdFrame],
    volume_m: Bounds,
    voxel_m: float,
    rays: int = RAYS,
) -> Iterator[ShadedView]:
    """Fuse `frames` one by one; yields the transfer of the hybrid buffer after each."""
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
    """Each frame under the light [16, 3] for its number."""
    for view in views:
        yield view.lit(light(view.frame.index))


def estimated_lights(
    device: Device, camera: CameraModel, frames: Iterable[LitFrame], wishes: Wishes
) -> Iterator[tuple[LitFrame, Floats]]:
    """Run the pipeline; yields each frame with its estimated light [16, 3].

    Raises ValueError for wishes that the pipeline cannot fulfil.
    """
    pipeline = ClientSession(device, camera, wishes)
    try:
        for item in frames:
            yield item, np.array(pipeline.process(item.frame).light.sh)
    finally:
        pipeline.close()
