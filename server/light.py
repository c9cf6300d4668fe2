"""The light of the room from one frame to the next: the estimator that a session's wishes call for.

Where all surfaces are of one albedo and indirect light is left out, spherical harmonics are solved for directly, in a
few milliseconds; else light, albedos and the room beyond the pictures are found together.
"""

from __future__ import annotations

import numpy as np
import pyopencl.array as cl_array

from protocol.frames import CameraModel
from server.geometry import GeometryFrame
from server.maths.light_change import Shot
from server.maths.lobes import cell_directions
from server.maths.sh import LUMINANCE, sh_basis
from server.opencl.engine import Engine
from server.settings import Settings
from server.stages.continuation import LEAST_GAIN_KNOWN, NO_PLANES, Continuation, PlaneArrays
from server.stages.indirect import Indirect, no_hits
from server.stages.light_estimation import LEAST_OPENNESS, LightEstimate, LightEstimator, gather_samples, sum_tiles
from server.stages.light_model import LightModel
from server.stages.lobe_estimator import LobeEstimator
from server.stages.radiance_transfer import Directions, Transfer
from server.stages.volume import Volume


class RoomLight:
    """One room's light, by the frames of all its cameras."""

    def __init__(self, engine: Engine, settings: Settings) -> None:
        self._engine = engine
        self._settings = settings
        self._model = _model_of(settings)
        is_plain = not self._model.albedos and settings.indirect == "none" and self._model.normals == "none"
        plain = LightEstimator(settings.bands, as_thesis=settings.as_thesis, memory=self._model.memory)
        self._harmonics = plain if is_plain or settings.as_thesis else None
        self._least_openness = LEAST_OPENNESS if "openness" in settings.robustness else 0.0
        self._lobes = LobeEstimator(engine, settings.bands, self._model, Continuation())
        self._given: LightEstimate | None = None

    @property
    def is_given(self) -> bool:
        """Whether the light is known beforehand."""
        return self._given is not None

    def give(self, light: LightEstimate) -> None:
        """Take this light (S2); what is then found is what of the room hides it."""
        light = self._colored(light)
        radiances = sh_basis(cell_directions(), round(len(light.sh) ** 0.5)) @ (light.sh @ LUMINANCE)
        self._given = light
        around = Continuation(LEAST_GAIN_KNOWN)
        self._lobes = LobeEstimator(self._engine, self._settings.bands, self._model, around, np.maximum(radiances, 0.0))

    def estimate(self) -> LightEstimate:
        """The light as it stands."""
        if self._given:
            return self._given
        return self._colored(self._harmonics.estimate() if self._harmonics else self._lobes.estimate())

    def _colored(self, estimate: LightEstimate) -> LightEstimate:
        return estimate.whitened() if self._settings.light_color == "white" else estimate

    @property
    def planes(self) -> PlaneArrays:
        """Surfaces taken to go on beyond what was seen of them: they hide light from virtual things too."""
        continuation = self._lobes.continuation
        return continuation.arrays() if continuation and not self._harmonics else NO_PLANES

    def update(
        self,
        camera: CameraModel,
        radiance: cl_array.Array,
        depth_m: cl_array.Array,
        geometry: GeometryFrame,
        volume: Volume,
        transfer: Transfer,
        rays: Directions,
        indirect: Indirect | None,
    ) -> LightEstimate:
        """The light with one more frame. radiance: [h, w] float4, depth_m [h, w], as in Measurement.

        indirect: what surfaces send, None to leave it out.
        """
        engine, surface = self._engine, geometry.surface
        if self._harmonics and self._given:
            return self._given
        if self._harmonics:
            tiles = sum_tiles(engine, camera, radiance, surface, transfer, volume.voxel_m, self._least_openness)
            with engine.profile.host():
                return self._colored(self._harmonics.update(tiles))
        observed = gather_samples(engine, camera, radiance, surface, transfer, self._least_openness)
        estimate = self._lobes.update(
            surface,
            camera,
            transfer,
            rays,
            observed,
            indirect or Indirect(no_hits(engine, transfer), np.zeros(3)),
            volume.voxel_m,
            Shot(geometry.volume_from_camera, geometry.exposure),
            depth_m,
        )
        return self._given or self._colored(estimate)


def _model_of(settings: Settings) -> LightModel:
    """What of the estimator is on (P3 and B2)."""
    asked = settings.robustness
    return LightModel(
        albedos=settings.albedo == "estimated",
        normals="printed" if "normals_printed" in asked else "even" if "normals" in asked else "none",
        memory="memory" in asked,
        outliers="outliers" in asked,
    )
