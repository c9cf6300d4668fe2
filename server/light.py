"""The light of the room from one frame to the next: the estimator that a session's wishes call for.

Where all surfaces are of one albedo and indirect light is left out, spherical harmonics are solved for directly, in a
few milliseconds; else light, albedos and the room beyond the pictures are found together.
"""

from __future__ import annotations

import pyopencl.array as cl_array

from protocol.frames import CameraModel
from server.geometry import GeometryFrame
from server.opencl.engine import Engine
from server.settings import Settings
from server.stages.continuation import NO_PLANES, Continuation, PlaneArrays
from server.stages.indirect import gather_hits, no_hits
from server.stages.light_estimation import LightEstimate, LightEstimator, gather_samples, sum_tiles
from server.stages.light_model import LightModel
from server.stages.lobe_estimator import LobeEstimator
from server.stages.radiance_transfer import Directions, Transfer
from server.stages.volume import Volume


class RoomLight:
    """One session's light."""

    def __init__(self, engine: Engine, camera: CameraModel, settings: Settings) -> None:
        self._engine = engine
        self._camera = camera
        self._settings = settings
        is_plain = settings.albedo == "constant" and settings.indirect == "none"
        self._harmonics = LightEstimator(settings.bands, as_thesis=settings.as_thesis) if is_plain else None
        model = LightModel(albedos=settings.albedo == "estimated")
        self._lobes = LobeEstimator(engine, settings.bands, model, Continuation())

    def estimate(self) -> LightEstimate:
        """The light as it stands."""
        return self._harmonics.estimate() if self._harmonics else self._lobes.estimate()

    @property
    def planes(self) -> PlaneArrays:
        """Surfaces taken to go on beyond what was seen of them: they hide light from virtual things too."""
        continuation = self._lobes.continuation
        return continuation.arrays() if continuation and not self._harmonics else NO_PLANES

    def update(
        self,
        radiance: cl_array.Array,
        depth_m: cl_array.Array,
        geometry: GeometryFrame,
        volume: Volume,
        transfer: Transfer,
        rays: Directions,
    ) -> LightEstimate:
        """The light with one more frame. radiance: [h, w] float4, depth_m [h, w], as in Measurement."""
        engine, camera, settings, surface = self._engine, self._camera, self._settings, geometry.surface
        if self._harmonics:
            tiles = sum_tiles(engine, camera, radiance, surface, transfer, volume.voxel_m)
            with engine.profile.host():
                return self._harmonics.update(tiles)
        observed = gather_samples(engine, camera, radiance, surface, transfer)
        if settings.indirect == "observed":
            hits = gather_hits(engine, camera, volume, surface, transfer, rays, settings.reach_m)
        else:
            hits = no_hits(engine, transfer)
        return self._lobes.update(
            surface, camera, transfer, rays, observed, hits, volume.voxel_m, geometry.volume_from_camera, depth_m
        )
