"""The spine: one RGB-D frame in; light, picture and plan out. Reads like figure 5.1 of the thesis."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import pyopencl.array as cl_array
from msgspec import structs
from numpy.typing import NDArray

from protocol.frames import CameraModel, RgbdFrame, Viewpoint
from protocol.messages import Hello, LeftOut, Light, OperatingPoint, Plan, Preset, Timings, Tracking, Wishes
from server.culling.reason import CullReason
from server.effects.table import effects_of
from server.geometry.geometry import Geometry, GeometryFrame
from server.input.denoise import denoise_radiance
from server.light.light_estimation import LightEstimate
from server.light.light_message import light_message, seen_from
from server.light.near_light import remove_lamps
from server.light.static_light import static_estimate
from server.maths.rigid import repaired_pose
from server.maths.sh import webxr_from_world
from server.meshing.scene_mesh import SceneMesh, scene_mesh
from server.meshing.surface import MeshingError
from server.objects.rasterize import Placed
from server.objects.scene_objects import check_room
from server.opencl.device import Device
from server.opencl.engine import Engine
from server.quality.operating_point_control import control_for
from server.quality.sampling_settings import SamplingSettings, asked_for
from server.quality.settings import Settings, read_wishes
from server.rendering import Rendering, RenderRequest, SpineOutputs
from server.reuse.frame_cache import TransferSamples
from server.reuse.temporal_reuse import TemporalReuse
from server.room.room import Room
from server.scene.mesh import Mesh
from server.scene.placement import Placement, check_size
from server.shading.composite import shown_picture, srgb_codes
from server.shading.layer import NOTHING, Layer
from server.tracking.alignment import Alignment
from server.tracking.exposure import scene_radiance
from server.transfer.indirect import observe_indirect
from server.transfer.sampling import TransferSampler
from server.volume.raycast import raycast
from server.volume.view_colors import view_colors
from server.volume.volume import Volume


@dataclass(frozen=True)
class FrameResult:
    """What one frame gave."""

    color: NDArray[np.uint8] | None
    """[h, w, 3] composite, sRGB; None: neither the client nor anybody else wants it."""
    light: Light
    world_from_camera: NDArray[np.float64]
    tracking: Tracking
    timings: Timings
    plan: Plan
    notes: tuple[str, ...]
    """What was wrong with this frame's input, one line each."""
    layer: Layer | None = None
    """What is virtual in it; None: the client does not want it apart."""


class Pipeline:
    """One client's spine and its state. Owned by one thread; what it shares with others is its room's."""

    def __init__(
        self,
        device: Device,
        camera: CameraModel,
        wishes: Wishes,
        room: Room | None = None,
        asked: Hello | None = None,
    ) -> None:
        """`room`: None for one of its own. `asked`: what the client says of its world's place in the room."""
        self._device = device
        self._room = room or Room(device, wishes)
        self._owns_room = room is None
        self._differences = self._room.differences(wishes)
        wishes = self._room.wishes_of(wishes)
        self._answer = wishes.answer
        self._asked = wishes
        self._control = control_for(device, wishes)  # U1
        self._wishes = self._control.chosen.point.wishes(wishes) if self._control else wishes
        self._settings: Settings = read_wishes(self._wishes)
        self._camera = camera
        self._engine = Engine(device, beside=self._room.engine)
        reconstruction = self._room.reconstruction
        self._alignment = Alignment(self._engine, camera, reconstruction, self._room.markers, asked)
        self._geometry = Geometry(self._engine, camera, wishes, reconstruction, self._alignment)
        self._sampler = self._make_sampler()
        self._room_light = self._room.light
        self._lamps = self._room.lamps
        self._rendering = Rendering(self._engine, camera, self._settings)
        self._rest = self._make_rest()
        self._objects = self._room.objects
        self._waiting: list[tuple[str, Mesh, Placement]] = []
        """Objects of a client that does not know yet where it is."""
        self._is_told_what_is_owed = False
        self._changes = 0
        self._webxr_from_client: NDArray[np.float64] | None = None
        self._mean_sent = np.zeros(3)
        self.device_name = device.name
        self.kernel_ms: dict[str, float] = {}

    def process(self, frame: RgbdFrame | Viewpoint, *, watched: bool = False) -> FrameResult:
        """Fuse one frame, estimate the light, render what is virtual. A viewpoint shows what others have scanned.

        `watched`: somebody wants the picture, whatever the client wished to be answered by.

        Raises ValueError with one line for a frame that is refused; the session's state is then as it was. Waits while
        another client's frame is in the room.
        """
        with self._room.lock:
            if self._changes != self._room.changes:
                self._wake()
            wanted = RenderRequest(self._answer, watched)
            result = self._process(self._imagined(frame) if isinstance(frame, Viewpoint) else frame, wanted)
            self._room.changes += 1
            self._changes = self._room.changes
            if not self._is_told_what_is_owed:
                self._is_told_what_is_owed = True
                own = {name for name, _, _ in self._waiting}
                result = replace(result, notes=(*result.notes, *self._objects.owed_notes(besides=own)))
            return result

    def _imagined(self, seen_from: Viewpoint) -> RgbdFrame:
        """What a camera there would see of what has been scanned, without depth. Raises ValueError."""
        volume, engine, camera = self._room.reconstruction.volume, self._engine, self._camera
        if volume is None:
            raise ValueError("nobody has scanned this room yet: there is nothing to look at")
        pose = repaired_pose(seen_from.world_from_camera)
        place = volume.volume_from_world() @ self._alignment.room_from_client @ pose
        volume.bring_back(camera, place)
        shown = engine.download(
            view_colors(engine, camera, raycast(engine, camera, place, volume, "looked_at"), volume)
        )
        linear = np.stack([shown[channel] for channel in "xyz"], axis=-1).astype(np.float64)
        is_linear = camera.color_encoding == "linear16"
        color = np.rint(65535 * linear.clip(0, 1)).astype(np.uint16) if is_linear else srgb_codes(linear)
        lens = camera.depth_lens
        depth = np.zeros((lens.height, lens.width), np.uint16)
        return RgbdFrame(seen_from.index, seen_from.timestamp_s, color, depth, pose, has_depth=False)

    def _process(self, frame: RgbdFrame, wanted: RenderRequest) -> FrameResult:
        started = time.perf_counter()
        engine, settings, stage = self._engine, self._settings, self._engine.profile.stage
        engine.profile.forget()
        geometry = self._geometry.update(frame, self._holds)  # ch. 4
        volume, objects = self._scene(geometry), self._objects
        if geometry.tracking == "lost":
            return self._lost(frame, geometry, volume, started, wanted)
        measurement, surface, notes = geometry.measurement, geometry.surface, self._place_waiting()

        placed = objects.placed(volume.volume_from_world())
        with stage("radiance_transfer"):  # 5.1.2, eq. 5.2
            sampled, left_out = self._sample(geometry, volume, placed, wanted)
        with stage("light_estimation"):  # 5.1.3, eq. 5.5-5.6
            estimate = self._room_light.estimate()
            if settings.plan != "everything" and not self._room_light.reads_pictures:
                stages = ("estimate_light", *(("denoise",) if settings.denoise != "none" else ()))
                left_out = dict.fromkeys(stages, NOTHING_TO_LEARN) | left_out
            if not frame.has_depth:
                left_out = {"estimate_light": ONLY_LOOKS} | left_out
            if "estimate_light" not in left_out and sampled.transfer is not None:
                smooth = self._smooth(geometry)
                distant = remove_lamps(engine, smooth, surface, volume, self._lamps.lamps)  # B4
                estimate = self._room_light.update(
                    self._camera,
                    distant,
                    measurement.depth_m,
                    geometry,
                    volume,
                    sampled.transfer,
                    self._sampler.rays,
                    sampled.indirect,
                )
        with stage("rendering"):  # 7.1-7.2, the effects this frame calls for
            planes, is_given = self._room_light.planes, self._room_light.is_given
            made = SpineOutputs(frame, geometry, volume, placed, self._sampler, sampled, estimate.sh, planes, is_given)
            drawn = self._rendering.draw(made, settings, left_out, self._rest, wanted)
        if not self._room_light.is_given and frame.has_depth:  # B4, for the frames to come
            with stage("light_estimation"):
                self._lamps.work(self._camera, geometry.scene_radiance, surface, volume)

        engine.queue.finish()
        rows, self.kernel_ms = engine.profile.collect()
        timings = Timings(**rows, total=(time.perf_counter() - started) * 1e3)
        point = self._next_point(timings, is_held=geometry.is_held)
        left_out_too = (*drawn.plan.left_out, *self._lamps.left_out())
        return FrameResult(
            color=drawn.picture,
            layer=drawn.layer,
            light=self._light_message(frame, geometry, estimate, volume),
            world_from_camera=self._alignment.in_client(geometry.world_from_camera),
            tracking=geometry.tracking,
            timings=timings,
            plan=structs.replace(drawn.plan, left_out=left_out_too, point=point),
            notes=(*geometry.notes, *notes, *self._differences, *_notes(estimate)),
        )

    def _lost(
        self, frame: RgbdFrame, geometry: GeometryFrame, volume: Volume, started: float, wanted: RenderRequest
    ) -> FrameResult:
        """The camera's own picture and the last light: where it is not known, nothing can be drawn or learnt."""
        self._wake()
        picture = None
        if wanted.answer == "picture" or wanted.watched:
            with self._engine.profile.stage("rendering"):
                picture = shown_picture(self._engine, self._camera, frame.color, geometry.measurement.radiance)
        effects = effects_of(wanted.answer)
        left_out = tuple(LeftOut(effect=e.name, reason="the camera is lost", error_bound=255.0) for e in effects)
        estimate = self._room_light.estimate()
        self._engine.queue.finish()
        rows, self.kernel_ms = self._engine.profile.collect()
        return FrameResult(
            color=picture,
            layer=NOTHING if wanted.answer == "layer" else None,
            light=self._light_message(frame, geometry, estimate, volume),
            world_from_camera=self._alignment.in_client(geometry.world_from_camera),
            tracking="lost",
            timings=Timings(**rows, total=(time.perf_counter() - started) * 1e3),
            plan=Plan(run=(), left_out=left_out),
            notes=(*geometry.notes, *self._differences, *_notes(estimate)),
        )

    def _smooth(self, geometry: GeometryFrame) -> cl_array.Array:
        """Radiance that the light is estimated from, denoised as the picture shows it, in the first picture's units."""
        settings = self._settings
        if settings.denoise == "none":
            return geometry.scene_radiance
        smooth = denoise_radiance(self._engine, geometry.measurement, settings.denoise, settings.denoise_iterations)
        return scene_radiance(self._engine, smooth, geometry.exposure, "smooth_scene_radiance")

    def _holds(self, frame: RgbdFrame) -> bool:
        """Whether what was made of the last frame holds for this one."""
        return self._rest is not None and self._rest.holds(frame, self._lamps.lamps)

    def _sample(
        self, geometry: GeometryFrame, volume: Volume, placed: list[Placed], wanted: RenderRequest
    ) -> tuple[TransferSamples, dict[str, CullReason]]:
        """Transfer, and what surfaces send (7.3.3); what of the spine is left out of this frame."""
        rest, draws = self._rest, bool(placed) and wanted.last is not None
        if rest is not None:
            rest.place(placed)
        if rest is None or rest.omission is None:
            echo = rest.echo if rest is not None and draws else None
            return self._sample_anew(geometry, volume), {"light_of_still_frames": echo} if echo else {}
        stages = ("estimate_light", *(SURFACE_STAGES if geometry.is_held else ()))
        left_out = dict.fromkeys(stages, rest.omission)
        kept = rest.held.sampled.get(rest.turn) if draws else TransferSamples(None, None)
        if kept is None:
            kept = self._sample_anew(geometry, volume)
            rest.held.keep_sampled(rest.turn, kept)
            return kept, left_out
        self._sampler.pass_frame()
        return kept, left_out | {"transfer_radiance": rest.omission}

    def _sample_anew(self, geometry: GeometryFrame, volume: Volume) -> TransferSamples:
        engine, camera, reach_m, surface = self._engine, self._camera, self._settings.reach_m, geometry.surface
        pose, up = geometry.volume_from_camera, self._objects.up
        transfer = self._sampler.transfer(volume, surface, pose, up, reach_m)
        if self._settings.indirect == "none":
            return TransferSamples(transfer, None)
        sent = observe_indirect(engine, camera, volume, surface, transfer, self._sampler.rays, reach_m)
        if sent.mean.any():  # where next to nothing is hidden, noise decides whether anything is met
            self._mean_sent = sent.mean
        return TransferSamples(transfer, replace(sent, mean=self._mean_sent))

    def _light_message(
        self, frame: RgbdFrame, geometry: GeometryFrame, estimate: LightEstimate, volume: Volume
    ) -> Light:
        lamps, exposure = self._lamps.lamps_at(volume.origin_world), geometry.exposure
        assert self._webxr_from_client is not None
        if not self._alignment.is_identity:
            estimate, lamps = seen_from(self._alignment.client_from_room, estimate, lamps)
        return light_message(frame.index, frame.timestamp_s, estimate, self._webxr_from_client, lamps, exposure)

    def place_object(self, object_id: str, mesh: Mesh, placement: Placement) -> tuple[str, ...]:
        """Put a mesh into the room, in the place of one with the same id; returns notes. Raises ValueError."""
        with self._room.lock:
            if self._alignment.is_settled or not self._objects.has_begun:
                self._objects.place(object_id, mesh, self._alignment.placed(placement))
                self._room.changes += 1
            else:
                others = [w for w in self._waiting if w[0] != object_id]
                check_room((other for _, other, _ in others), mesh)
                check_size(mesh, placement)
                self._waiting = [*others, (object_id, mesh, placement)]
                self._objects.owe(object_id)
                return (*mesh.notes, "it is placed once this client is aligned with the room")
        return mesh.notes

    def move_object(self, object_id: str, placement: Placement) -> None:
        """Give an object another place. Raises KeyError if there is none of that id."""
        with self._room.lock:
            mesh = next((mesh for name, mesh, _ in self._waiting if name == object_id), None)
            if mesh is None:
                self._objects.move(object_id, self._alignment.placed(placement))
            else:
                check_size(mesh, placement)
                self._waiting = [*(w for w in self._waiting if w[0] != object_id), (object_id, mesh, placement)]

    def remove_object(self, object_id: str) -> None:
        """Take an object away. Raises KeyError if there is none of that id."""
        with self._room.lock:
            left = [waiting for waiting in self._waiting if waiting[0] != object_id]
            if len(left) < len(self._waiting):
                self._waiting = left
                self._objects.forgive(object_id)
                return
            self._objects.remove(object_id)
            self._room.changes += 1

    def _place_waiting(self) -> tuple[str, ...]:
        """Place what has waited until this client was aligned; what was wrong with it, one line each."""
        problems = []
        for object_id, mesh, placement in self._waiting:
            try:
                self._objects.place(object_id, mesh, self._alignment.placed(placement))
                self._wake()
            except ValueError as error:
                problems.append(f"object {object_id!r}: {error}")
        self._waiting = []
        return tuple(problems)

    def set_quality(
        self, preset: Preset, budget_ms: float | None = None, max_light_error_deg: float | None = None
    ) -> None:
        """Sample transfer in another way from the next frame on, or as a budget or a light error asks for.

        Raises ValueError for a preset that does not exist, and where the device's front is not known.
        """
        asked = structs.replace(
            self._wishes, preset=preset, budget_ms=budget_ms, max_light_error_deg=max_light_error_deg
        )
        control = control_for(self._device, asked)
        as_asked = (
            SamplingSettings.of(self._asked)
            if preset == self._asked.preset
            else SamplingSettings(preset=preset, rays=self._asked.rays)
        )
        with self._room.lock:
            self._sample_at(control.chosen.point if control else as_asked)
            self._control = control

    def _next_point(self, timings: Timings, *, is_held: bool) -> OperatingPoint:
        """What this frame's point was; the next frame's is settled by what this one took, unless little had to be made:
        that says nothing of frames of which all has to be."""
        if self._control is None:
            return asked_for(self._wishes)
        said = self._control.said
        if is_held:
            return said
        self._control.observe(timings)
        self._sample_at(self._control.chosen.point)
        return said

    def _sample_at(self, point: SamplingSettings) -> None:
        """Nothing is remembered from another point but the room and its light. Raises ValueError."""
        wishes = point.wishes(self._wishes)
        settings = read_wishes(wishes)
        is_same = (settings.sampling, settings.rays) == (self._settings.sampling, self._settings.rays)
        self._wishes, self._settings = wishes, settings
        if not is_same:
            self._sampler = self._make_sampler()
            self._rest = self._make_rest()

    def scene_mesh(self, progress: Callable[[int, int], None] = lambda _done, _total: None) -> SceneMesh:
        """The surface fused so far as triangles. Raises MeshingError, one line, where there is none."""
        with self._room.lock:
            volume, exposure = self._geometry.volume, self._room.reconstruction.usual_exposure
            if volume is None or self._webxr_from_client is None:
                raise MeshingError("there is no surface to mesh: no frame has been fused yet")
            bricks = volume.download_bricks()
        bricks = replace(bricks, colors=np.float32(exposure) * bricks.colors)
        upright = self._webxr_from_client @ self._alignment.client_from_room[:3, :3]
        return scene_mesh(bricks, volume.voxel_m, volume.origin_world, upright, progress)

    @property
    def device_bytes(self) -> int:
        """Device memory of this session and its room: arrays and volume; what all sessions share is not counted."""
        return self._engine.workspace.bytes_held + self._room.device_bytes

    def close(self) -> None:
        """Give the device's memory back, and the room's where it is this session's alone."""
        with self._room.lock:
            self._engine.close()
        if self._owns_room:
            self._room.close()

    def _make_sampler(self) -> TransferSampler:
        settings = self._settings
        return TransferSampler(self._engine, self._camera, settings.sampling, settings.rays, settings.bands)

    def _make_rest(self) -> TemporalReuse | None:
        """None where everything is to be simulated."""
        if self._settings.plan == "everything":
            return None
        engine, camera, poses = self._engine, self._camera, self._asked.poses
        return TemporalReuse(engine, camera, poses=poses, period=self._sampler.period)

    def _wake(self) -> None:
        """Something that pictures do not show is new."""
        if self._rest is not None:
            self._rest.forget()

    def _scene(self, geometry: GeometryFrame) -> Volume:
        """The volume; the first frame says what is up for the objects."""
        volume = self._geometry.volume
        assert volume is not None
        camera_up, forward = -geometry.world_from_camera[:3, 1], geometry.world_from_camera[:3, 2]
        if not self._objects.has_begun:
            up = np.array(self._wishes.up or camera_up, np.float64)
            up /= np.linalg.norm(up)
            given = static_estimate(self._wishes, self._settings.bands, webxr_from_world(up, forward))  # S2
            if given:
                self._room_light.give(given)
            self._objects.begin(up)
        if self._webxr_from_client is None or not self._alignment.is_settled:
            turn = self._alignment.client_from_room[:3, :3]
            self._webxr_from_client = webxr_from_world(turn @ self._objects.up, turn @ forward)
        return volume


def _notes(estimate: LightEstimate) -> tuple[str, ...]:
    return ("no usable surface has been seen yet, the light is unknown",) if estimate.std is None else ()


NOTHING_TO_LEARN = CullReason("the light is given, and nothing else is learnt from the picture", 0.0)

ONLY_LOOKS = CullReason("a client without depth adds nothing to the room's light", 0.0)

SURFACE_STAGES = ("locate", "raycast", "merge_depth")
"""Of the geometry, what is not done where nothing has changed."""
