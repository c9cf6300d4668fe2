"""The spine: one RGB-D frame in; light, picture and plan out. Reads like figure 5.1 of the thesis."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from msgspec import structs
from numpy.typing import NDArray

from protocol.frames import CameraModel, RgbdFrame
from protocol.messages import LeftOut, Light, PlacedObject, Plan, Timings, Tracking, Wishes
from server.culling.reason import CullReason
from server.culling.spine import LOST, spine_left_out
from server.effects.renderer import Renderer, RenderRequest, RenderResult, SpineOutputs
from server.effects.table import effect_names
from server.frame_context import FrameContext
from server.geometry.geometry import Geometry, GeometryFrame, check_size
from server.input.measure import measure
from server.light.light_estimation import LightEstimate
from server.objects.rasterize import Placed
from server.opencl.engine import Engine
from server.quality.settings import Settings
from server.reuse.frame_cache import FrameCache
from server.reuse.temporal_reuse import NO_REUSE, ReuseDecision, SceneVersion, TemporalReuse
from server.room.client_light import ClientLight
from server.room.client_objects import ClientObjects
from server.room.frame_view import frame_view, surface_on_ray
from server.room.room import Room
from server.room.spots import SpotView
from server.shading.composite import shown_picture
from server.shading.kept_changes import KeptChanges
from server.shading.layer import NOTHING, Layer
from server.shading.touched_discs import without_touched
from server.shading.traced_scene import middles_of
from server.tracking.alignment import Alignment
from server.transfer.samples import NO_SAMPLES, SampledTransfer, TransferSamples
from server.volume.volume import Volume


@dataclass(frozen=True)
class FrameResult:
    """What one frame gave."""

    color: NDArray[np.uint8] | None
    """[h, w, 3] composite, sRGB; None: neither the client nor anybody else wants it."""
    light: Light
    world_from_camera: NDArray[np.float64]
    """[4, 4] in the client's world."""
    tracking: Tracking
    timings: Timings
    plan: Plan
    notes: tuple[str, ...]
    """What was wrong with this frame's input, one line each."""
    layer: Layer | None = None
    """What is virtual in it; None: the client does not want it apart."""
    is_reused: bool = False
    """Whether the geometry of the frame before was kept."""
    placed: tuple[PlacedObject, ...] = ()
    """Objects whose spots were found in it."""


class Pipeline:
    """One camera's spine and its state. Owned by one thread, which holds the room's lock during a frame."""

    def __init__(
        self,
        engine: Engine,
        camera: CameraModel,
        wishes: Wishes,
        settings: Settings,
        room: Room,
        alignment: Alignment,
        objects: ClientObjects,
    ) -> None:
        """`alignment`: of the client's world with the room's. `objects`: the client's."""
        self._engine = engine
        self._camera = camera
        self._settings = settings
        self._room = room
        self._alignment = alignment
        self._objects = objects
        self._geometry = Geometry(engine, camera, wishes, room.reconstruction)
        self._transfer = SampledTransfer(
            engine,
            camera,
            settings.sampling,
            settings.rays,
            settings.bands,
            is_cached=settings.has_caches and not room.light.needs_transfer,
        )
        self._cache = FrameCache(engine)
        self._renderer = Renderer(engine, self._cache, settings)
        self._reuse = None if settings.plan == "everything" else TemporalReuse(engine, camera, poses=wishes.poses)
        self.light = ClientLight(engine, room, alignment, wishes.light_at)
        self._frames = self._losses = self._samplings = 0
        self.kernel_ms: dict[str, float] = {}
        """Device time of each kernel in the last frame."""

    def use(self, settings: Settings) -> None:
        """Sample as these settings say from the next frame on."""
        if (settings.sampling, settings.rays) != (self._settings.sampling, self._settings.rays):
            self._transfer.use(settings.sampling, settings.rays)
            self._samplings += 1
        self._settings = settings

    def process_frame(self, frame: RgbdFrame, request: RenderRequest, *, waits_for_light: bool) -> FrameResult:
        """Fuse one frame, estimate the light, render what is virtual (fig. 5.1). waits_for_light: as in FrameContext.

        Raises ValueError with one line for a frame that is refused; the state is then as it was.
        """
        engine, room, stage = self._engine, self._room, self._engine.profile.stage
        engine.profile.begin()
        check_size(self._camera, frame)
        volume = self._geometry.volume_for(self._alignment.in_room(frame))

        with stage("input"):  # 5.1.1
            measurement = measure(engine, self._camera, frame)
            unaligned = self._alignment.settle(frame, measurement)
            frame = self._alignment.in_room(frame)
            notes = self._objects.place_waiting(frame.index)
            reuse = self._decide_reuse(frame, volume)
        if reuse.keeps_geometry:
            geometry = self._geometry.keep(frame, measurement, volume)
        else:
            geometry = self._geometry.update(frame, measurement, volume, unaligned)  # ch. 4, eq. 4.1-4.5
        is_fresh = frame.has_depth and geometry.tracking != "lost" and reuse.reason is None
        notes += room.orient(engine, geometry, self._settings.bands, has_surface=is_fresh)
        self._alignment.note_view(room.objects.up, geometry.world_from_camera)
        if geometry.tracking == "lost":
            return self._lost_frame(frame, geometry, volume, notes, request)
        if reuse.reason is None:
            notes += self._objects.place_on_spots(frame.index, lambda: self._spot_view(frame, geometry, volume))
        notes += self._objects.check_placed(volume)

        context = self._context(geometry, volume, reuse, waits_for_light=waits_for_light)
        objects = room.objects.placed(volume.volume_from_world())
        is_shaded = bool(objects) and request.is_drawn
        is_learning = self._settings.plan == "everything" or not room.light.is_given
        with stage("light_estimation"):  # 5.1.3
            self.light.begin(context, is_learnt=is_learning and frame.has_depth and reuse.reason is None)
            engine.send_reads()  # the light's are needed before the device has drawn
        with stage("radiance_transfer"):  # 5.1.2, eq. 5.2; 7.3.3
            needs_transfer = is_shaded or room.light.needs_transfer or self._settings.plan == "everything"
            samples, is_kept = self._sample_transfer(context, reuse, is_shaded, needs_transfer)
        left_out = self._left_out(frame, reuse, is_kept, is_shaded, needs_transfer, is_learning)
        is_drawn_first = room.light.has_model  # with the light of the frames before
        if not is_drawn_first:
            with stage("light_estimation"):  # eq. 5.5-5.6
                light = self.light.update(context, samples, self._settings, left_out, is_still=reuse.keeps_geometry)
        with stage("rendering"):  # 7.1-7.2, the effects that this frame calls for
            spine = self._spine_outputs(context, frame, objects, samples, left_out)
            rendered = self._renderer.render(context, spine, self._settings, reuse, request)
        if is_drawn_first:
            with stage("light_estimation"):  # while the device draws
                light = self.light.update(context, samples, self._settings, left_out, is_still=reuse.keeps_geometry)
        if not room.light.is_given and frame.has_depth:  # B4, for the frames to come
            with stage("light_estimation"):
                room.lamps.work(self._camera, context.scene_radiance, context.surface, volume)

        if self._reuse is not None:
            self._reuse.observe(reuse, spine.sh, rendered.reference)
        return self._result(frame, geometry, volume, light, rendered, notes)

    def _spot_view(self, frame: RgbdFrame, geometry: GeometryFrame, volume: Volume) -> SpotView:
        """This frame, for places that are found in it."""
        engine = self._engine
        seen = frame_view(engine, self._camera, geometry, volume, self._room.objects.up, frame.index)
        return SpotView(
            frame=seen,
            meet=lambda origin, direction: surface_on_ray(engine, volume, origin, direction),
            room_from_client=self._alignment.room_from_client,
        )

    def _decide_reuse(self, frame: RgbdFrame, volume: Volume) -> ReuseDecision:
        """What of earlier frames holds for this one, now that it was measured."""
        if self._reuse is None:
            return NO_REUSE
        room = self._room
        scene = SceneVersion(room.changes - self._frames, self._losses, self._samplings, room.lamps.lamps)
        objects = room.objects.placed(volume.volume_from_world()) if room.objects.has_begun else ()
        return self._reuse.decide(frame, scene, objects, period=self._transfer.period)

    def _context(
        self, geometry: GeometryFrame, volume: Volume, reuse: ReuseDecision, *, waits_for_light: bool
    ) -> FrameContext:
        settings = self._settings
        return FrameContext(
            engine=self._engine,
            camera=self._camera,
            volume=volume,
            volume_from_camera=geometry.volume_from_camera,
            measurement=geometry.measurement,
            surface=geometry.surface,
            scene_radiance=geometry.scene_radiance,
            exposure=geometry.exposure,
            sampling=self._transfer.sampling,
            rays=self._transfer.rays,
            ray_length_m=settings.ray_length_m,
            smooth_edges=settings.edges == "smooth",
            restores_clipped=not settings.as_thesis,
            waits_for_light=waits_for_light,
            follows_light=not settings.has_caches or reuse.reason is not None,
        )

    def _sample_transfer(
        self, context: FrameContext, reuse: ReuseDecision, is_shaded: bool, needs_transfer: bool
    ) -> tuple[TransferSamples, bool]:
        """The samples of this frame, and whether a still view needed no new ones."""
        if not needs_transfer:
            self._transfer.skip_frame()
            return NO_SAMPLES, False
        if reuse.reason is not None:
            kept = self._cache.find(TransferSamples, reuse.samples_version) if is_shaded else NO_SAMPLES
            if kept is not None:
                self._transfer.skip_frame()
                return kept, True
        samples = self._transfer.sample(
            context.volume,
            context.surface,
            context.volume_from_camera,
            self._room.objects.up,
            context.ray_length_m,
            with_indirect=self._settings.indirect != "none",
            is_kept=reuse.reason is not None,
            renews=reuse.renews_transfer,
        )
        if reuse.reason is not None:
            self._cache.keep(samples, reuse.samples_version, frozenset({"cells"}))
        return samples, False

    def _left_out(
        self,
        frame: RgbdFrame,
        reuse: ReuseDecision,
        is_kept: bool,
        is_shaded: bool,
        needs_transfer: bool,
        is_learning: bool,
    ) -> dict[str, CullReason]:
        return spine_left_out(
            reuse.reason,
            reuse.echo if is_shaded else None,
            keeps_geometry=reuse.keeps_geometry,
            keeps_transfer=is_kept,
            needs_transfer=needs_transfer,
            light_is_given=not is_learning,
            denoises=self._settings.denoise != "none",
            has_depth=frame.has_depth,
        )

    def _spine_outputs(
        self,
        context: FrameContext,
        frame: RgbdFrame,
        objects: list[Placed],
        samples: TransferSamples,
        left_out: dict[str, CullReason],
    ) -> SpineOutputs:
        sh, split, places = self._room.light.seen_by_objects(middles_of(objects), context.volume.origin_world)
        return SpineOutputs(
            frame=frame,
            objects=objects,
            samples=samples,
            depth_views=self._transfer.depth_views,
            period=self._transfer.period,
            sh=sh,
            split=without_touched(split, objects),
            light_places=places,
            is_light_given=self._room.light.is_given,
            left_out=left_out,
        )

    def _lost_frame(
        self,
        frame: RgbdFrame,
        geometry: GeometryFrame,
        volume: Volume,
        notes: tuple[str, ...],
        request: RenderRequest,
    ) -> FrameResult:
        """The camera's own picture and the last light: where the camera is lost, nothing can be drawn or learnt."""
        self._losses += 1
        picture = None
        if request.wants_picture:
            with self._engine.profile.stage("rendering"):
                picture = shown_picture(self._engine, self._camera, frame.color, geometry.measurement.radiance)
        left_out = tuple(
            LeftOut(effect=name, reason=LOST.reason, error_bound=LOST.error_bound)
            for name in effect_names(request.answer)
        )
        layer = NOTHING if request.answer == "layer" else None
        rendered = RenderResult(picture, layer, Plan(run=(), left_out=left_out))
        return self._result(frame, geometry, volume, self._room.light.estimate(), rendered, notes)

    def _result(
        self,
        frame: RgbdFrame,
        geometry: GeometryFrame,
        volume: Volume,
        light: LightEstimate,
        rendered: RenderResult,
        notes: tuple[str, ...],
    ) -> FrameResult:
        """The answer, once the device is done."""
        picture, plan = rendered.picture(), rendered.told_plan()
        self._engine.send_reads()
        self._engine.finish()
        timings = self._timings()
        self._frames += 1
        self._room.changes += 1
        kept = self._transfer.left_out(self._engine.state(KeptChanges).bounds())
        others = (*kept, *self._room.lamps.left_out()) if geometry.tracking != "lost" else ()
        return FrameResult(
            color=picture,
            layer=rendered.layer,
            light=self.light.message(frame, light, volume, geometry.exposure),
            world_from_camera=self._alignment.in_client(geometry.world_from_camera),
            tracking=geometry.tracking,
            timings=timings,
            plan=structs.replace(plan, left_out=(*plan.left_out, *others)),
            notes=(*geometry.notes, *notes, *self.light.notes(light)),
            is_reused=geometry.is_reused,
        )

    def _timings(self) -> Timings:
        profile = self._engine.profile
        counted = Timings(
            launches=profile.launches, reads=profile.reads, read_bytes=profile.read_bytes, copies=profile.copies
        )
        times = profile.collect()
        self.kernel_ms = times.kernels
        return structs.replace(counted, **times.rows, total=times.total, host=times.idle)
