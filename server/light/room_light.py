"""The light of a room over time, by the estimator that the wishes select.

The thesis's estimator, and one constant albedo without indirect light, solve spherical harmonics directly. All else is
one model of the room (shell/).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import pyopencl.array as cl_array
from numpy.typing import NDArray

from server.frame_context import FrameContext
from server.light.arriving import arriving_radiance, arriving_sh, distant_light
from server.light.light_estimation import LEAST_OPENNESS, Evidence, LightEstimate, LightEstimator, sum_tiles
from server.light.place_light import PlaceLight
from server.light.shell.known_room import KnownRoom
from server.light.shell.room_model import RoomModel
from server.light.shell.solution import LookUp, Solution
from server.light.shell.solver_process import Asked
from server.light.shell.switches import Switches
from server.maths.direct_lights import SplitLight, split_light
from server.maths.light_places import EVERYWHERE, LightPlaces, places_of
from server.maths.sh import LUMINANCE
from server.opencl.engine import Engine
from server.quality.settings import Settings
from server.transfer.samples import TransferSamples
from server.volume.volume import Volume


@dataclass(frozen=True)
class KnownRoomLight:
    """State of a room's light, for saving and resuming."""

    given: LightEstimate | None
    evidence: Evidence | None
    remembered: LightEstimate | None
    """The light that clients were told last."""
    room: KnownRoom | None = None
    """None in saves of earlier programs."""


class RoomLight:
    """One room's light, estimated from the frames of all its cameras."""

    def __init__(self, settings: Settings) -> None:
        self._settings = settings
        switches = _switches(settings)
        is_plain = not switches.albedos and not switches.indirect and switches.normals == "none"
        plain = LightEstimator(settings.bands, as_thesis=settings.as_thesis, memory=switches.memory)
        self._harmonics = plain if is_plain or settings.as_thesis else None
        self._least_openness = LEAST_OPENNESS if "openness" in settings.robustness else 0.0
        self._model = RoomModel(switches, self._asked_of_solutions)
        self._asked: NDArray[np.float64] | None = None
        """[n, 3] places that objects saw the light from last, world."""
        self._given: LightEstimate | None = None
        self._remembered: LightEstimate | None = None
        """The light of earlier frames, until the first new frame."""

    @property
    def is_given(self) -> bool:
        """Whether the light is known beforehand."""
        return self._given is not None

    @property
    def estimates_one_light(self) -> bool:
        """Whether what it estimates is one light for the whole room, and not a light by place."""
        return self._harmonics is not None

    @property
    def needs_transfer(self) -> bool:
        """Whether it is estimated from the radiance transfer of the samples."""
        return self._harmonics is not None and self._given is None

    def give(self, light: LightEstimate) -> None:
        """Take this light (S2)."""
        self._given = self._colored(light)

    def estimate(self) -> LightEstimate:
        """The light as it stands."""
        if self._given:
            return self._given
        if self._harmonics:
            return self._colored(self._harmonics.estimate())
        return self._colored(self._remembered or self._model.estimate(self._settings.bands))

    @property
    def has_model(self) -> bool:
        """Whether the light of the room is known by place: not where one light is given or estimated for all of it."""
        return self._solution is not None

    @property
    def _solution(self) -> Solution | None:
        is_by_place = self._given is None and self._harmonics is None
        return self._model.solution if is_by_place else None

    def seen_by_objects(
        self, middles: NDArray[np.float64], origin_world: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], SplitLight, LightPlaces]:
        """Light [places, bands^2, 3] from beyond the scan for objects with `middles` [objects, 3], volume metres.

        Besides, its discs and what they leave, and the places. origin_world: [3] of the volume.
        """
        solution = self._solution
        if solution is None or not len(middles):
            sh = self.estimate().sh
            split = split_light(sh)
            return sh[None], SplitLight(split.rest[None], split.discs), EVERYWHERE
        places = places_of(middles)
        self._asked = places.positions + origin_world
        whole, rest, lamps = solution.beyond(self._asked, self._settings.bands)
        if self._settings.light_color == "white":
            whole, rest = _whitened(whole), _whitened(rest)
            lamps = [replace(lamp, radiance=_whitened(lamp.radiance)) for lamp in lamps]
        discs = tuple(lamp.as_direct_light(origin_world) for lamp in lamps)
        return whole, SplitLight(rest, discs), places

    def _asked_of_solutions(self) -> Asked:
        return Asked(self._settings.bands, self._settings.light_color == "white", self._asked)

    def look_up(self, context: FrameContext, positions: NDArray[np.float64]) -> LookUp | None:
        """Begin to trace what `arriving_at` needs; None where there is no solution, or this frame takes another."""
        solution = None if self._model.is_due(waits=context.waits_for_light) else self._solution
        return solution.look_up(context.engine, context.volume, positions) if solution else None

    def finish(self) -> None:
        """Begin what is worked out beside the frames. The last of a frame."""
        self._model.finish()

    def arriving_at(
        self, engine: Engine, volume: Volume, positions: NDArray[np.float64], begun: LookUp | None = None
    ) -> tuple[PlaceLight, ...]:
        """The light that arrives at each of `positions` [n, 3] (world metres), in units of the first picture.

        begun: of look_up, used if it is of the same places and solution."""
        if solution := self._solution:
            is_begun = begun and begun.solution is solution and np.array_equal(begun.positions, positions)
            found = solution.arriving(begun if begun and is_begun else solution.look_up(engine, volume, positions))
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
        if solution := self._solution:
            radiance = solution.radiance_at(engine, volume, position, directions)
            return _whitened(radiance) if self._settings.light_color == "white" else radiance
        beyond = distant_light(self.estimate().sh)
        radiance, _ = arriving_radiance(engine, volume, position[None], directions, beyond)
        return np.asarray(radiance[0])

    def known(self) -> KnownRoomLight:
        """All that it is estimated from."""
        evidence = self._harmonics.evidence() if self._harmonics else None
        estimate = self._remembered or self._model.estimate(self._settings.bands)
        told = estimate if estimate.std is not None else None
        return KnownRoomLight(self._given, evidence, told, self._model.known())

    def resume(self, known: KnownRoomLight) -> None:
        """Go on with what was known of this room, by the same settings."""
        if known.given:
            self.give(known.given)
        if self._harmonics and known.evidence:
            self._harmonics.resume(known.evidence)
        if known.room:
            self._model.resume(known.room)
        self._remembered = known.remembered

    def _colored(self, estimate: LightEstimate) -> LightEstimate:
        return estimate.whitened if self._settings.light_color == "white" else estimate

    def close(self) -> None:
        """End what is worked out beside the frames; it cannot be used any more."""
        self._model.close()

    def begin(self, context: FrameContext) -> None:
        """Let the device gather what a frame says of the light; `update` takes it in."""
        if not self._given and not self._harmonics:
            self._model.begin(context)

    def update(
        self, context: FrameContext, radiance: cl_array.Array, samples: TransferSamples, up: NDArray[np.float64]
    ) -> LightEstimate:
        """The light with one more frame, whose samples have transfer if `needs_transfer`.

        radiance: [h, w] float4 as in Measurement, without what lamps add. up: [3] unit, world.
        """
        engine = context.engine
        if self._given:
            return self._given
        if self._harmonics:
            assert samples.transfer is not None
            tiles = sum_tiles(
                engine,
                context.camera,
                radiance,
                context.surface,
                samples.transfer,
                context.volume.voxel_m,
                self._least_openness,
            )
            self._harmonics.update(tiles)
            return self.estimate()
        self._model.update(context, up)
        if self._model.solution is not None:
            self._remembered = None
        return self.estimate()


def _whitened(sh: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.asarray((sh @ LUMINANCE)[..., None] * np.ones(3))


def _switches(settings: Settings) -> Switches:
    """What of the estimator is on (P3 and B2)."""
    asked = settings.robustness
    return Switches(
        albedos=settings.albedo == "estimated",
        indirect=settings.indirect != "none",
        normals="printed" if "normals_printed" in asked else "even" if "normals" in asked else "none",
        memory="memory" in asked,
        outliers="outliers" in asked,
    )
