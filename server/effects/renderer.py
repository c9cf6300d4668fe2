"""The last part of a frame (thesis 7.1-7.2): its effects are planned and run, or taken from the cache."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
import pyopencl.array as cl_array
import pyopencl.cltypes as cl_types
from msgspec import structs
from numpy.typing import NDArray

from protocol.frames import RgbdFrame
from protocol.messages import LeftOut, Plan
from server.culling.facts_finder import FactsFinder
from server.culling.reason import CullReason
from server.culling.rules import NO_INDIRECT, NO_LIGHT, NO_OBJECT, NOTHING_TO_MATCH, OWN_SCALE, SOFT, TRACED
from server.culling.scene_facts import SceneFacts
from server.effects.plan import Resource, make_plan
from server.effects.resources import (
    KnownLight,
    PictureParts,
    ReturnedRadiance,
    SharpLight,
    VirtualObjects,
)
from server.effects.table import COMPOSE_LAYER, COMPOSITE, EFFECTS, FAINT_SHADOWS, Answer, effect_names
from server.frame_context import FrameContext
from server.input.measure import Measurement
from server.maths.direct_lights import SplitLight
from server.maths.light_places import LightPlaces
from server.objects.rasterize import Placed
from server.opencl.buffers import BufferDescription, StageBuffers
from server.opencl.engine import Engine
from server.opencl.pending_read import PendingRead
from server.quality.settings import Settings
from server.reuse.frame_cache import FrameCache
from server.reuse.temporal_reuse import ReuseDecision
from server.shading.composite import CompositeInputs, composite, composite_on_device, shown_picture
from server.shading.kept_changes import KeptChanges, shadows_left_out
from server.shading.layer import Layer, compose_layer
from server.shading.tone_mapping import AverageMemory, Averages, measure_averages
from server.shading.traced_scene import DeviceLight, upload_light
from server.transfer.indirect import Indirect
from server.transfer.radiance_transfer import TURNS, Transfer
from server.transfer.real_depth_views import RealDepthViews
from server.transfer.samples import TransferSamples

Picture = NDArray[np.uint8]

LASTING = frozenset({"virtual"})
"""The same for all direction sets, and written only where an object has moved."""
DRAWN_BY_CLIENT = CullReason("asked for: the client draws by itself", 0.0)


class _Buffers(StageBuffers):
    unlit = BufferDescription(cl_types.float4)
    """[h, w] zeros."""


@dataclass(frozen=True)
class RenderRequest:
    """What is to be drawn of a frame."""

    answer: Answer = "picture"
    """What its client gets."""
    watched: bool = False
    """Whether somebody else is to see the picture."""

    @property
    def is_drawn(self) -> bool:
        """Whether anything is drawn at all."""
        return self.answer != "light" or self.watched

    @property
    def wants_picture(self) -> bool:
        """Whether the composite is shown to anybody."""
        return self.answer == "picture" or self.watched


@dataclass(frozen=True)
class SpineOutputs:
    """What the spine found out about a frame, besides its FrameContext."""

    frame: RgbdFrame
    objects: list[Placed]
    samples: TransferSamples
    """Not read where nothing virtual is there."""
    depth_views: RealDepthViews | None
    """What visibility was looked up in; None where rays are traced."""
    period: int
    """Frames after which a still view is sampled the same again."""
    sh: NDArray[np.float64]
    """[places, bands^2, 3] the light, in the first picture's units."""
    split: SplitLight
    """The same as discs and a rest."""
    light_places: LightPlaces
    is_light_given: bool
    left_out: Mapping[str, CullReason]
    """What of the spine was left out."""


@dataclass(frozen=True)
class RenderResult:
    """What was requested, the rest None. The device may be at work on it."""

    drawing: PendingRead | Picture | None
    layer: Layer | None
    plan: Plan
    """Without what `told_plan` adds."""
    changes: Changes | None = None
    reference: Picture | None = None
    """At a checkpoint: the virtual things over what the camera saw when the view began."""
    kept: KeptChanges | None = None
    """How far off are shadows of earlier frames; None: it has none."""

    def picture(self) -> Picture | None:
        """The picture, waited for."""
        return self.drawing.result() if isinstance(self.drawing, PendingRead) else self.drawing

    def told_plan(self) -> Plan:
        """The plan as it turned out, waited for."""
        plan = _with_changes(self.plan, self.changes) if self.changes else self.plan
        if self.kept is None:
            return plan
        return structs.replace(plan, left_out=(*plan.left_out, shadows_left_out(self.kept.bounds())))


@dataclass(frozen=True)
class Changes:
    """Where virtual things change real surface."""

    cells: PendingRead
    """Of the picture: 1 where they do."""
    has_sharp_shadows: bool
    """Beside `cells`."""


@dataclass(frozen=True)
class CachedEffects:
    """The effects of a frame of a still view, for one direction set."""

    parts: PictureParts
    plan: Plan
    changes: Changes | None


@dataclass(frozen=True)
class FirstSight:
    """What the camera saw when a view began."""

    shown: Picture
    measurement: Measurement


class Renderer:
    """One session's."""

    def __init__(self, engine: Engine, cache: FrameCache, settings: Settings) -> None:
        self._engine = engine
        self._cache = cache
        self._everything = settings.plan == "everything"
        self._average_memory = AverageMemory()
        self._facts = FactsFinder(everything=self._everything)

    def render(
        self,
        context: FrameContext,
        spine: SpineOutputs,
        settings: Settings,
        reuse: ReuseDecision,
        request: RenderRequest,
    ) -> RenderResult:
        """What is requested of a frame, and the plan that says what was left out."""
        if not request.is_drawn:
            culled = {**spine.left_out, **dict.fromkeys(effect_names("picture"), DRAWN_BY_CLIENT)}
            return RenderResult(None, None, Plan(run=(), left_out=_left_out(culled)))
        shown = shown_picture(context.engine, context.camera, spine.frame.color, context.measurement.radiance)
        cached = self._cache.find(CachedEffects, reuse.version) if reuse.reason is not None else None
        if cached is not None and reuse.reason is not None:
            plan = _reused(cached.plan, spine.left_out, reuse.reason)
            return replace(_composed(context, shown, cached.parts, plan, request), changes=cached.changes)
        kept = self._engine.state(KeptChanges)
        kept.begin_frame()
        parts, plan = self._run_effects(context, spine, settings, shown)
        result = _composed(context, shown, parts, plan, request)
        if not context.follows_light and (parts.ratio or parts.occluded):
            result = replace(result, kept=kept)
        if parts.changed is not None:
            changes = Changes(self._engine.begin_download(parts.changed), has_sharp_shadows=bool(parts.light.discs))
            result = replace(result, changes=changes)
        if reuse.reason is not None and spine.period <= TURNS:
            self._cache.keep(CachedEffects(parts, plan, result.changes), reuse.version, LASTING)
        if reuse.is_checkpoint and request.answer != "light" and spine.objects:
            return replace(result, reference=self._reference(context, shown, parts, reuse))
        return result

    def _run_effects(
        self, context: FrameContext, spine: SpineOutputs, settings: Settings, shown: Picture
    ) -> tuple[PictureParts, Plan]:
        """What the picture is composed of, and the plan that made it."""
        averages = self._averages(context, spine, settings)  # 7.1, H
        light = _upload(context, spine, spine.split if spine.objects else None)  # 7.2.3
        gain = averages.gain if averages is not None else 1.0
        has_indirect = settings.indirect != "none"
        facts = self._facts.find(
            context, spine.objects, spine.samples, light, spine.sh, spine.split, shown, gain, has_indirect=has_indirect
        )
        given = _given(context, spine, light, averages, facts)
        effects = make_plan(EFFECTS, PictureParts, given, facts, everything=self._everything, stages=spine.left_out)
        parts, plan = effects.execute(given), effects.described()
        return parts, plan

    def _averages(self, context: FrameContext, spine: SpineOutputs, settings: Settings) -> Averages | None:
        """Mean luminances of the picture and of its shading; None where virtual things are not to match them."""
        wished, transfer = settings.tone_mapping, spine.samples.transfer
        keeps_scale = wished == "light" or (wished == "auto" and spine.is_light_given)
        if not spine.objects or transfer is None or keeps_scale:
            return None
        found = measure_averages(
            self._engine,
            context.camera,
            context.measurement.radiance,
            context.surface,
            transfer,
            context.rays,
            _upload(context, spine, None),
            spine.samples.indirect,
            context.ray_length_m,
        )
        return self._average_memory.update(found, context.exposure)

    def _reference(self, context: FrameContext, shown: Picture, parts: PictureParts, reuse: ReuseDecision) -> Picture:
        """The virtual things of this frame over what the camera saw when the view began."""
        first = self._cache.find(FirstSight, reuse.view_version)
        if first is None:
            first = self._cache.keep(FirstSight(shown.copy(), context.measurement), reuse.view_version)
        context = replace(context, measurement=first.measurement)
        return composite(context.engine, first.shown, composite_inputs(context, parts))


def _upload(context: FrameContext, spine: SpineOutputs, split: SplitLight | None) -> DeviceLight:
    """The frame's light, whole or without the discs of `split`."""
    indirect = spine.samples.indirect
    return upload_light(context.engine, spine.sh, context.rays, indirect, context.exposure, spine.light_places, split)


def _given(
    context: FrameContext, spine: SpineOutputs, light: DeviceLight, averages: Averages | None, facts: SceneFacts
) -> dict[Resource, object]:
    """The resources that effects begin with; a reason in place of one that is absent."""
    samples = spine.samples
    return {
        FrameContext: context,
        DeviceLight: light,
        VirtualObjects: spine.objects or NO_OBJECT,
        KnownLight: light if spine.sh.any() else NO_LIGHT,
        SharpLight: light if light.discs else SOFT,
        RealDepthViews: spine.depth_views or TRACED,
        Transfer: samples.transfer or NO_OBJECT,
        Indirect: samples.indirect or (NO_OBJECT if facts.indirect else NO_INDIRECT),
        ReturnedRadiance: facts.returned,
        Averages: _to_match(averages),
    }


def _to_match(averages: Averages | None) -> Averages | CullReason:
    if averages is None:
        return OWN_SCALE
    return averages if averages.are_known else NOTHING_TO_MATCH


def composite_inputs(context: FrameContext, parts: PictureParts) -> CompositeInputs:
    """The arguments of the kernels that put the parts together, over the camera's picture of `context`."""
    return CompositeInputs(
        camera=context.camera,
        volume_from_camera=context.volume_from_camera,
        radiance=context.measurement.radiance,
        codes=context.measurement.codes,
        surface=context.surface,
        tolerance_m=context.volume.voxel_m,
        light=parts.light,
        virtual=parts.virtual,
        occluded=parts.occluded,
        ratio=parts.bounced or parts.ratio,
        refined_occluded=parts.refined_occluded,
        refined_ratio=parts.refined_ratio,
        upsampling=context.sampling.upsampling,
        reflected=parts.reflected,
        gain=1.0 if parts.gain is None else parts.gain,
        direct_virtual=_direct_virtual(context, parts),
        direct_ratio=parts.direct_ratio,
        reached=parts.changed,
        restores_clipped=context.restores_clipped,
    )


def _direct_virtual(context: FrameContext, parts: PictureParts) -> cl_array.Array | None:
    """What the discs of the light bring to virtual surface: zeros where this was left out."""
    if parts.direct_virtual is not None or parts.virtual is None or not parts.light.discs:
        return parts.direct_virtual
    return context.engine.buffers(_Buffers).unlit.constant(np.zeros(context.surface.positions.shape, cl_types.float4))


def _composed(
    context: FrameContext, shown: Picture, parts: PictureParts, plan: Plan, request: RenderRequest
) -> RenderResult:
    """The picture, the layer, or both."""
    engine, inputs = context.engine, composite_inputs(context, parts)
    layer = compose_layer(engine, inputs) if request.answer == "layer" else None
    drawing: PendingRead | Picture | None = None
    if request.wants_picture:
        on_device = None if inputs.is_nothing else composite_on_device(engine, shown, inputs)
        drawing = shown if on_device is None else engine.begin_download(on_device)
    ends = [name for name, end in ((COMPOSE_LAYER, layer), (COMPOSITE, drawing)) if end is not None]
    return RenderResult(drawing, layer, structs.replace(plan, run=(*plan.run, *ends)))


def _reused(plan: Plan, left_out: Mapping[str, CullReason], reason: CullReason) -> Plan:
    """The plan of a frame whose effects were made by an earlier one."""
    reused = _left_out(dict.fromkeys((*left_out, *plan.run), reason))
    others = (left for left in plan.left_out if left.effect not in left_out)
    return structs.replace(plan, run=(), left_out=(*reused, *others))


def _with_changes(plan: Plan, changes: Changes) -> Plan:
    """The plan with the share of the picture in which real surface changes."""
    share = float(changes.cells.result().mean())
    aside = ", sharp shadows aside" if changes.has_sharp_shadows else ""
    reason = f"virtual things change {100 * share:.0f} % of the picture{aside}, and hardly the rest"
    said = (
        structs.replace(left, reason=reason) if left.effect == FAINT_SHADOWS.name else left for left in plan.left_out
    )
    return structs.replace(plan, left_out=tuple(said))


def _left_out(reasons: Mapping[str, CullReason]) -> tuple[LeftOut, ...]:
    return tuple(LeftOut(effect=name, reason=why.reason, error_bound=why.error_bound) for name, why in reasons.items())
