"""E1 (thesis 5.3.1): the reconstructed scene shaded with a known light goes through the pipeline as its camera picture.

The shading comes from ten times as many directions as the estimate uses, so what is tested is the sampling of
visibility, the 8-bit picture and the estimator; the geometry is the same on both sides, as the thesis has it. One
shading stands for each 4 x 4 pixels, which is what REG4 looks at.
"""

from __future__ import annotations

from dataclasses import replace

import msgspec
import numpy as np
import pytest
from numpy.typing import NDArray

from client.options.source import open_source
from client.sources.volume import default_volume, default_voxel
from client.synthetic.lighting.lights import ring_light
from protocol.frames import CameraModel, RgbdFrame
from protocol.messages import Wishes
from server.client_session import ClientSession
from server.light.light_estimation import ASSUMED_ALBEDO
from server.maths.sh import dominant_direction
from server.opencl.device import Device
from server.opencl.engine import Engine
from server.shading.composite import srgb_codes
from server.transfer.radiance_transfer import direction_sets, transfer_radiance
from server.volume.raycast import raycast
from server.volume.volume import Volume
from tests.scenes.plain_light import PLAIN_LIGHT
from tests.scenes.volumes import fuse_frame

FRAMES = range(1, 30, 3)
STRIDE = 4
REFERENCE_RAYS = 810
BOUNDS_DEG = {81: 5.0, 243: 3.0}
"""By the number of rays, for one albedo and no indirect light, as the pictures are made. Seen: 0.9 to 3.9 at 81 rays,
0.5 to 2.4 at 243. What is left is quadrature: the least squares of harmonics takes its error for signal."""


class Shot:
    """One frame of the synthetic table and the transfer of what is reconstructed when it has been fused."""

    def __init__(self, frame: RgbdFrame, transfer: NDArray[np.float64], covered: NDArray[np.bool_]) -> None:
        self.frame, self.transfer, self.covered = frame, transfer, covered

    def brightest(self, light: NDArray[np.float64]) -> float:
        return float((self.transfer @ light)[self.covered].max())

    def under(self, light: NDArray[np.float64]) -> RgbdFrame:
        """The frame with a picture under `light` [16, 3], as 8-bit sRGB; grey where there is no surface."""
        radiance = np.where(self.covered[..., None], ASSUMED_ALBEDO * (self.transfer @ light), 0.5)
        return replace(self.frame, color=np.kron(srgb_codes(radiance), np.ones((STRIDE, STRIDE, 1), np.uint8)))


class Path:
    """A camera path over the synthetic table, reconstructed as the pipeline does it."""

    def __init__(self, device: Device) -> None:
        source = open_source("synthetic:table?frames=30&size=320x240")
        self.camera: CameraModel = source.camera
        bounds = default_volume(source, range(30))
        self.wishes = Wishes(volume_m=bounds, voxel_m=default_voxel(bounds), preset="reg4", **PLAIN_LIGHT)
        engine = Engine(device)
        volume = Volume(engine, bounds, default_voxel(bounds))
        self.shots = [self._shot(engine, volume, source[index]) for index in FRAMES]
        engine.close()

    def _shot(self, engine: Engine, volume: Volume, frame: RgbdFrame) -> Shot:
        pose, _ = fuse_frame(engine, volume, self.camera, frame)
        surface = raycast(engine, self.camera, pose, volume)
        rays = direction_sets(REFERENCE_RAYS, 4)
        transfer = transfer_radiance(engine, self.camera, volume, surface, STRIDE, rays, 1000.0)
        covered = engine.download(transfer.openness) >= 0
        return Shot(frame, engine.download(transfer.coefficients).astype(np.float64), covered)


@pytest.fixture(scope="module")
def path(device: Device) -> Path:
    return Path(device)


@pytest.mark.parametrize("rays", BOUNDS_DEG)
@pytest.mark.parametrize("number", range(8))
def test_ring_of_eight_is_recovered_at_reg4(device: Device, path: Path, number: int, rays: int) -> None:
    light = ring_light(number).sh
    light = light * (0.8 / (ASSUMED_ALBEDO * max(shot.brightest(light) for shot in path.shots)))  # nothing clips
    pipeline = ClientSession(device, path.camera, msgspec.structs.replace(path.wishes, rays=rays))
    for shot in path.shots:
        estimated = np.array(pipeline.process(shot.under(light)).light.sh)
    pipeline.close()
    cosine = np.clip(dominant_direction(estimated) @ dominant_direction(light), -1, 1)
    error_deg = float(np.degrees(np.arccos(cosine)))
    print(f"light {number}, {rays} rays: {error_deg:.2f} degrees")  # noqa: T201
    assert error_deg <= BOUNDS_DEG[rays]
