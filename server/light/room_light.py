"""The light of a room over time, by the estimator that the wishes select.

With one constant albedo and no indirect light, spherical harmonics are solved directly in a few milliseconds. Otherwise
light, albedos and the unobserved parts of the room are estimated together.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import pyopencl.array as cl_array
from numpy.typing import NDArray

from server.frame_context import FrameContext
from server.light.arriving import arriving_radiance, arriving_sh, distant_light
from server.light.continuation import LEAST_GAIN_KNOWN, NO_PLANES, Continuation, PlaneArrays
from server.light.light_estimation import (
    LEAST_OPENNESS,
    Evidence,
    LightEstimate,
    LightEstimator,
    gather_samples,
    sum_tiles,
)
from server.light.light_model import LightModel
from server.light.lobe_estimator import KnownLight, LobeEstimator
from server.light.place_light import PlaceLight
from server.light.shell.room_model import RoomModel
from server.maths.direct_lights import SplitLight, split_light
from server.maths.light_change import Shot
from server.maths.lobes import cell_directions
from server.maths.sh import LUMINANCE, sh_basis
from server.opencl.engine import Engine
from server.quality.settings import Settings
from server.transfer.indirect import Indirect, no_hits
from server.transfer.samples import TransferSamples
from server.volume.volume import Volume

AS_SURE = 1.1
"""New frames tell the light as well as those before a restart did, if they leave at most so many times the doubt."""


@dataclass(frozen=True)
class KnownRoomLight:
    """State of a room's light, for saving and resuming."""

    given: LightEstimate | None
    evidence: Evidence | None
    lobes: KnownLight
    remembered: LightEstimate | None
    """What was told last, where frames do not say it any more when it is taken up again."""


class RoomLight:
    """One room's light, estimated from the frames of all its cameras."""

    def __init__(self, engine: Engine, settings: Settings) -> None:
        self._engine = engine
        self._settings = settings
        self._model = _model_of(settings)
        is_plain = not self._model.albedos and settings.indirect == "none" and self._model.normals == "none"
        plain = LightEstimator(settings.bands, as_thesis=settings.as_thesis, memory=self._model.memory)
        self._harmonics = plain if is_plain or settings.as_thesis else None
        self._least_openness = LEAST_OPENNESS if "openness" in settings.robustness else 0.0
        self._lobes = LobeEstimator(engine, settings.bands, self._model, Continuation())
        self._model_of_room = RoomModel()
        self._given: LightEstimate | None = None
        self._remembered: LightEstimate | None = None
        """Of earlier frames that are not there any more: it holds until new ones say better."""

    @property
    def is_given(self) -> bool:
        """Whether the light is known beforehand."""
        return self._given is not None

    @property
    def reads_pictures(self) -> bool:
        """Whether `update` learns anything: of a light that is given, harmonics have nothing to learn."""
        return not (self._harmonics and self._given)

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
        if self._harmonics:
            return self._colored(self._harmonics.estimate())
        return self._colored(self._remembered or self._lobes.estimate())

    @property
    def has_model(self) -> bool:
        """Whether the light of the room is known by place: not where one light is given or estimated for all of it."""
        return self._model_of_room.is_known and self._given is None and self._harmonics is None

    def seen_by_objects(
        self, position: NDArray[np.float64], origin_world: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], SplitLight, PlaneArrays]:
        """Light [bands^2, 3] from beyond the scan for objects at `position` [3] (world), its discs, what hides it.

        origin_world: [3] of the volume, in whose space discs have their places.
        """
        if not self.has_model:
            sh = self.estimate().sh
            return sh, split_light(sh), self.planes
        whole, rest, lamps = self._model_of_room.beyond(position, self._settings.bands)
        if self._settings.light_color == "white":
            whole, rest = _whitened(whole), _whitened(rest)
            lamps = [replace(lamp, radiance=_whitened(lamp.radiance)) for lamp in lamps]
        discs = tuple(lamp.as_direct_light(origin_world) for lamp in lamps)
        return whole, SplitLight(rest, discs), NO_PLANES

    def arriving_at(self, engine: Engine, volume: Volume, positions: NDArray[np.float64]) -> tuple[PlaceLight, ...]:
        """The light that arrives at each of `positions` [n, 3] (world metres), in units of the first picture."""
        if self.has_model:
            found = self._model_of_room.arriving_at(engine, volume, positions)
            if self._settings.light_color == "white":
                found = [replace(light, sh=_whitened(light.sh)) for light in found]
            return tuple(found)
        light = self.estimate()
        sh, seen = arriving_sh(engine, volume, positions, distant_light(light.sh))
        places = zip(positions, sh, seen, strict=True)
        return tuple(PlaceLight(where, found, None, None, light.valid, float(share)) for where, found, share in places)

    def radiance_at(
        self, engine: Engine, volume: Volume, position: NDArray[np.float64], directions: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """[m, 3] radiance that arrives at `position` [3] (world metres) from unit `directions` [m, 3] (world axes)."""
        if self.has_model:
            radiance = self._model_of_room.radiance_at(engine, volume, position, directions)
            return _whitened(radiance) if self._settings.light_color == "white" else radiance
        beyond = distant_light(self.estimate().sh)
        radiance, _ = arriving_radiance(engine, volume, position[None], directions, beyond)
        return np.asarray(radiance[0])

    def known(self) -> KnownRoomLight:
        """All but the frames that it is estimated from."""
        evidence = self._harmonics.evidence() if self._harmonics else None
        estimate = self._remembered or self._lobes.estimate()
        told = estimate if estimate.std is not None else None
        return KnownRoomLight(self._given, evidence, self._lobes.known(), told)

    def resume(self, known: KnownRoomLight) -> None:
        """Go on with what was known of this room, by the same settings. The first frames are too few to judge by."""
        if known.given:
            self.give(known.given)
        if self._harmonics and known.evidence:
            self._harmonics.resume(known.evidence)
        self._lobes.resume(known.lobes)
        self._remembered = known.remembered

    def _colored(self, estimate: LightEstimate) -> LightEstimate:
        return estimate.whitened() if self._settings.light_color == "white" else estimate

    @property
    def planes(self) -> PlaneArrays:
        """Surfaces taken to go on beyond what was seen of them: they hide light from virtual things too."""
        continuation = self._lobes.continuation
        return continuation.arrays() if continuation and not self._harmonics else NO_PLANES

    def update(
        self, context: FrameContext, radiance: cl_array.Array, samples: TransferSamples, up: NDArray[np.float64]
    ) -> LightEstimate:
        """The light with one more frame, whose samples have transfer.

        radiance: [h, w] float4 as in Measurement, without what lamps add. up: [3] unit, world.
        """
        engine, camera, surface, transfer = context.engine, context.camera, context.surface, samples.transfer
        assert transfer is not None
        voxel_m = context.volume.voxel_m
        if self._harmonics and self._given:
            return self._given
        if self._harmonics:
            tiles = sum_tiles(engine, camera, radiance, surface, transfer, voxel_m, self._least_openness)
            with engine.profile.host():
                return self._colored(self._harmonics.update(tiles))
        if self._given is None:
            self._model_of_room.update(context, up)
        steady, before = self._lobes.steady, self._lobes.estimate()
        observed = gather_samples(engine, camera, radiance, surface, transfer, self._least_openness)
        estimate = self._lobes.update(
            surface,
            camera,
            transfer,
            context.rays,
            observed,
            samples.indirect or Indirect(no_hits(engine, transfer), np.zeros(3)),
            voxel_m,
            Shot(context.volume_from_camera, context.exposure),
            context.measurement.depth_m,
        )
        if self._remembered and estimate is not before:
            has_changed = self._lobes.steady < steady
            if has_changed or _doubt(estimate) <= AS_SURE * _doubt(self._remembered):
                self._remembered = None
        return self._given or self._colored(self._remembered or estimate)


def _whitened(sh: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.asarray(np.outer(sh @ LUMINANCE, np.ones(3)))


def _doubt(estimate: LightEstimate) -> float:
    """Of the light's direction: one standard deviation, over the even light."""
    if estimate.std is None:
        return float("inf")
    return float(np.linalg.norm(estimate.std[1:4] @ LUMINANCE) / max(float(estimate.sh[0] @ LUMINANCE), 1e-12))


def _model_of(settings: Settings) -> LightModel:
    """What of the estimator is on (P3 and B2)."""
    asked = settings.robustness
    return LightModel(
        albedos=settings.albedo == "estimated",
        normals="printed" if "normals_printed" in asked else "even" if "normals" in asked else "none",
        memory="memory" in asked,
        outliers="outliers" in asked,
    )
