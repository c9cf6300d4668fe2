"""The last part of a frame (thesis 7.1-7.2): the effects it calls for, planned and run, or held where nothing moves."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import wraps
from typing import Any

import numpy as np
from msgspec import structs
from numpy.typing import NDArray

from protocol.frames import CameraModel, RgbdFrame
from protocol.messages import LeftOut, Plan
from server.culling.facts_finder import FactsFinder
from server.culling.reason import CullReason
from server.effects.functions import View, composite, shadow_everywhere
from server.effects.plan import Effect, execute, make_plan
from server.effects.table import EFFECTS, Answer
from server.geometry.geometry import GeometryFrame
from server.light.continuation import PlaneArrays
from server.maths.direct_lights import split_light
from server.objects.rasterize import Placed
from server.opencl.engine import Engine
from server.quality.settings import Settings
from server.reuse.frame_cache import CachedEffects, FrameCache, TransferSamples
from server.reuse.temporal_reuse import TemporalReuse
from server.shading.composite import shown_picture
from server.shading.layer import Layer
from server.shading.tone_mapping import AverageMemory, Averages, measure_averages
from server.shading.traced_scene import DeviceLight, take_discs, upload_light
from server.transfer.radiance_transfer import TURNS
from server.transfer.sampling import TransferSampler
from server.volume.volume import Volume

Picture = NDArray[np.uint8]

GIVEN = frozenset(
    {
        "view",
        "objects",
        "volume",
        "rays",
        "real_looks",
        "shown",
        "measurement",
        "surface",
        "transfer",
        "indirect",
        "light",
        "averages",
        "returned",
    }
)
"""What effects read that is none's."""
SEEN = frozenset({"view", "shown", "measurement", "surface", "volume"})
"""What the picture is put together from that is this frame's own, whatever is held."""


@dataclass(frozen=True)
class SpineOutputs:
    """What the spine made of a frame."""

    frame: RgbdFrame
    geometry: GeometryFrame
    volume: Volume
    objects: list[Placed]
    sampler: TransferSampler
    sampled: TransferSamples
    """Its own, or a held one. Not read where nothing virtual is there."""
    sh: NDArray[np.float64]
    """[bands^2, 3] the light, in the first picture's units."""
    planes: PlaneArrays
    is_light_given: bool


@dataclass(frozen=True)
class RenderRequest:
    """What is to be drawn of a frame."""

    answer: Answer = "picture"
    """What its client gets."""
    watched: bool = False
    """Whether somebody else is to see the picture."""

    @property
    def last(self) -> Effect[Any] | None:
        """The effect that all others are for; None: nothing is drawn."""
        if self.answer == "light" and not self.watched:
            return None
        return LAYER if self.answer == "layer" else PICTURE


@dataclass(frozen=True)
class Drawn:
    """What was wanted, the rest None."""

    picture: Picture | None
    layer: Layer | None
    plan: Plan


class Rendering:
    """One session's."""

    def __init__(self, engine: Engine, camera: CameraModel, settings: Settings) -> None:
        self._engine = engine
        self._camera = camera
        self._everything = settings.plan == "everything"
        self._average_memory = AverageMemory()
        self._facts = FactsFinder(everything=self._everything)

    def draw(
        self,
        made: SpineOutputs,
        settings: Settings,
        left_out: Mapping[str, CullReason],
        rest: TemporalReuse | None,
        wanted: RenderRequest,
    ) -> Drawn:
        """What is wanted, and the plan that says what was left out, `left_out` of the spine with it.

        rest: where a view that stands still holds what was made of it; None: everything is to be made. What it learns
        does not depend on who watches: a session that is answered by lights alone rests once its light has settled.
        """
        is_held = rest is not None and rest.omission is not None
        old: Picture | None = None
        if wanted.last is None:
            drawn = Drawn(None, None, _undrawn(left_out))
        else:
            shown = shown_picture(self._engine, self._camera, made.frame.color, made.geometry.measurement.radiance)
            if rest is not None and rest.omission is not None and rest.turn in rest.held.finished:
                return self._finish(
                    made, settings, shown, rest.held.finished[rest.turn], left_out, rest.omission, wanted
                )
            result, parts, plan = self._make(made, settings, shown, left_out, wanted.last)
            if rest is not None and is_held and made.sampler.period <= TURNS:
                rest.held.keep_finished(rest.turn, {k: v for k, v in parts.items() if k not in SEEN}, plan)
            drawn = _drawn(result, parts, shown, plan, wanted)
            if rest is not None and not is_held and wanted.answer != "light" and made.objects and rest.is_checkpoint:
                old = _picture_of_old(rest.held, parts, shown)
        if rest is not None and not is_held:
            rest.learn(made.sh, made.planes, old)
        return drawn

    def _make(
        self,
        made: SpineOutputs,
        settings: Settings,
        shown: Picture,
        left_out: Mapping[str, CullReason],
        last: Effect[Any],
    ) -> tuple[Picture | Layer, dict[str, Any], Plan]:
        """What the last effect makes, what it reads, and the plan that ends with it."""
        given = self._given(made, settings, shown)
        facts = self._facts.find(
            given["view"],
            made.geometry,
            made.volume,
            made.sampler.rays,
            given["transfer"],
            given["indirect"],
            made.objects,
            given["light"],
            made.sh,
            shown,
            given["averages"],
        )
        given["returned"] = facts.returned
        order, plan = make_plan(EFFECTS, last.writes, GIVEN, facts, everything=self._everything, stages=left_out)
        parts: dict[str, Any] = {}
        result: Picture | Layer = execute([*order[:-1], _noting(order[-1], parts)], given, last.writes)
        if "reached" in parts:
            plan = _with_share(plan, float(self._engine.download(parts["reached"]).mean()), bool(given["light"].discs))
        return result, parts, plan

    def _given(self, made: SpineOutputs, settings: Settings, shown: Picture) -> dict[str, Any]:
        """The resources that effects begin with."""
        engine, geometry, rays = self._engine, made.geometry, made.sampler.rays
        transfer, indirect = made.sampled.transfer, made.sampled.indirect
        light = upload_light(engine, made.sh, rays, made.planes, indirect, geometry.exposure)
        averages = None
        if made.objects:
            averages = self._averages(made, settings, light)  # 7.1, H
            light = take_discs(engine, light, split_light(made.sh), rays, geometry.exposure)  # 7.2.3
        return {
            "view": self._view(made, settings),
            "objects": made.objects,
            "volume": made.volume,
            "rays": rays,
            "real_looks": made.sampler.looks,
            "shown": shown,
            "measurement": geometry.measurement,
            "surface": geometry.surface,
            "transfer": transfer,
            "indirect": indirect,
            "light": light,
            "averages": averages,
        }

    def _view(self, made: SpineOutputs, settings: Settings) -> View:
        is_smooth, pose = settings.edges == "smooth", made.geometry.volume_from_camera
        return View(self._engine, self._camera, pose, settings.reach_m, made.sampler.sampling, is_smooth)

    def _averages(self, made: SpineOutputs, settings: Settings, light: DeviceLight) -> Averages | None:
        """What pictures and their shading are on average, if virtual things are to match them."""
        asked, transfer, indirect = settings.tone_mapping, made.sampled.transfer, made.sampled.indirect
        if transfer is None or asked == "light" or (asked == "auto" and made.is_light_given):
            return None
        found = measure_averages(
            self._engine,
            self._camera,
            made.geometry.measurement.radiance,
            made.geometry.surface,
            transfer,
            made.sampler.rays,
            light,
            indirect,
            settings.reach_m,
        )
        return self._average_memory.update(found, made.geometry.exposure)

    def _finish(
        self,
        made: SpineOutputs,
        settings: Settings,
        shown: Picture,
        finished: CachedEffects,
        left_out: Mapping[str, CullReason],
        why: CullReason,
        wanted: RenderRequest,
    ) -> Drawn:
        """What is wanted, of what has been made of a frame that was sampled alike."""
        assert wanted.last is not None
        parts = {
            **finished.parts,
            "view": self._view(made, settings),
            "shown": shown,
            "measurement": made.geometry.measurement,
            "surface": made.geometry.surface,
            "volume": made.volume,
        }
        result: Picture | Layer = execute([wanted.last], parts, wanted.last.writes)
        *effects, last = finished.plan.run
        held = tuple(_left_out(name, why) for name in (*left_out, *effects))
        others = (left for left in finished.plan.left_out if left.effect not in left_out)
        plan = structs.replace(finished.plan, run=(last,), left_out=(*held, *others))
        return _drawn(result, parts, shown, plan, wanted)


def _drawn(
    result: Picture | Layer, parts: Mapping[str, Any], shown: Picture, plan: Plan, wanted: RenderRequest
) -> Drawn:
    """What the last effect of a plan made of `parts`, and the picture where that is wanted besides."""
    if not isinstance(result, Layer):
        return Drawn(result, None, plan)
    if not wanted.watched:
        return Drawn(None, result, plan)
    picture = composite(**{**parts, "shown": shown})
    return Drawn(picture, result, structs.replace(plan, run=(*plan.run, PICTURE.name)))


def _undrawn(left_out: Mapping[str, CullReason]) -> Plan:
    """Of a frame that is answered by its light alone."""
    omissions = {**left_out, **{effect.name: BY_ITSELF for effect in EFFECTS}}
    return Plan(run=(), left_out=tuple(_left_out(name, why) for name, why in omissions.items()))


def _picture_of_old(held: FrameCache, parts: Mapping[str, Any], shown: Picture) -> Picture:
    """What is virtual in this frame, put into what the camera saw when the view began to stand still."""
    shown, measurement = held.keep_old(shown, parts["measurement"])
    return composite(**{**parts, "shown": shown, "measurement": measurement})


PICTURE: Effect[Any] = next(effect for effect in EFFECTS if effect.writes == "picture")
LAYER: Effect[Any] = next(effect for effect in EFFECTS if effect.writes == "layer")
BY_ITSELF = CullReason("asked for: the client draws by itself", 0.0)


def _with_share(plan: Plan, share: float, has_sharp_shadows: bool) -> Plan:
    """The plan as it turned out: how much of the picture is not left as it is. share: of its cells."""
    aside = ", sharp shadows aside" if has_sharp_shadows else ""
    reason = f"virtual things change {100 * share:.0f} % of the picture{aside}, and hardly the rest"
    said = (
        structs.replace(left, reason=reason) if left.effect == shadow_everywhere.__name__ else left
        for left in plan.left_out
    )
    return structs.replace(plan, left_out=tuple(said))


def _left_out(name: str, why: CullReason) -> LeftOut:
    return LeftOut(effect=name, reason=why.reason, error_bound=why.error_bound)


def _noting(effect: Effect[Any], parts: dict[str, Any]) -> Effect[Any]:
    """The same effect, which leaves in `parts` what it reads."""
    run: Callable[..., Any] = effect.run

    @wraps(run)
    def noted(**reads: Any) -> Any:
        parts.update(reads)
        return run(**reads)

    return Effect(noted, effect.writes, through=effect.through)
