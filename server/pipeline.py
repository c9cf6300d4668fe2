"""The spine: one RGB-D frame in; light, picture and plan out. Reads like figure 5.1 of the thesis."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import pyopencl.array as cl_array
from msgspec import structs
from numpy.typing import NDArray

from protocol.frames import CameraModel, RgbdFrame
from protocol.messages import LeftOut, Light, Plan, Timings, Tracking, Wishes
from server.effects import EFFECTS, View
from server.facts_finder import FactsFinder
from server.geometry import Geometry, GeometryFrame
from server.light import RoomLight
from server.light_message import light_message
from server.maths.direct_lights import split_light
from server.maths.sh import webxr_from_world
from server.meshing.scene_mesh import SceneMesh, scene_mesh
from server.meshing.surface import MeshingError
from server.opencl.device import Device
from server.opencl.engine import Engine
from server.plan import execute, make_plan
from server.rest import Rest
from server.scene.mesh import Mesh
from server.scene.objects import SceneObjects, check_room
from server.scene.placement import Placement, check_size
from server.settings import Settings, read_wishes, sampling_of
from server.stages.composite import shown_picture
from server.stages.denoise import denoise_radiance
from server.stages.exposure import scene_radiance
from server.stages.indirect import Indirect, observe_indirect
from server.stages.lamp_finder import LampFinder
from server.stages.light_estimation import LightEstimate
from server.stages.near_light import remove_lamps
from server.stages.radiance_transfer import Transfer
from server.stages.sampling import Sampling, TransferSampler
from server.stages.tone_mapping import AverageMemory, Averages, measure_averages
from server.stages.traced_scene import DeviceLight, take_discs, upload_light
from server.stages.volume import Volume
from server.static_light import static_estimate


@dataclass(frozen=True)
class FrameResult:
    """What one frame gave."""

    color: NDArray[np.uint8]
    """[h, w, 3] composite, sRGB."""
    light: Light
    world_from_camera: NDArray[np.float64]
    tracking: Tracking
    timings: Timings
    plan: Plan
    notes: tuple[str, ...]
    """What was wrong with this frame's input, one line each."""


class Pipeline:
    """One session's spine and its state. Owned by one thread."""

    def __init__(self, device: Device, camera: CameraModel, wishes: Wishes) -> None:
        self._settings: Settings = read_wishes(wishes)
        self._camera = camera
        self._wishes = wishes
        self._engine = Engine(device)
        self._geometry = Geometry(self._engine, camera, wishes)
        self._sampler = self._make_sampler(self._settings.sampling)
        self._room_light = RoomLight(self._engine, camera, self._settings)
        self._lamps = LampFinder(self._engine, camera, self._settings.lamps)
        self._average_memory = AverageMemory()
        self._rest = Rest()
        self._facts = FactsFinder(everything=self._settings.plan == "everything")
        self._objects: SceneObjects | None = None
        self._waiting: list[tuple[str, Mesh, Placement]] = []
        self._webxr_from_world = np.eye(3)
        self.device_name = device.name
        self.kernel_ms: dict[str, float] = {}

    def process(self, frame: RgbdFrame) -> FrameResult:
        """Fuse one frame, estimate the light, render what is virtual.

        Raises ValueError with one line for a frame that is refused; the session's state is then as it was.
        """
        started = time.perf_counter()
        engine, camera, settings, stage = self._engine, self._camera, self._settings, self._engine.profile.stage
        engine.profile.forget()
        geometry = self._geometry.update(frame)  # ch. 4
        volume, objects = self._scene(geometry)
        if geometry.tracking == "lost":
            return self._lost(frame, geometry, volume, started)
        measurement, surface = geometry.measurement, geometry.surface

        placed = objects.placed(volume.volume_from_world())
        rest = None if settings.plan == "everything" else self._rest.found(frame, geometry, self._lamps.lamps)
        left_out = {} if rest is None else {"estimate_light": rest}
        if rest is not None and not placed:
            left_out["transfer_radiance"] = rest
        with stage("radiance_transfer"):  # 5.1.2, eq. 5.2
            transfer, indirect = None, None
            if "transfer_radiance" not in left_out:
                transfer = self._sampler.transfer(
                    volume, surface, geometry.volume_from_camera, objects.up, settings.reach_m
                )
                indirect = self._observe_indirect(geometry, volume, transfer)  # 7.3.3
        with stage("light_estimation"):  # 5.1.3, eq. 5.5-5.6
            estimate = self._room_light.estimate()
            if "estimate_light" not in left_out and transfer is not None:
                smooth = self._smooth(geometry)
                distant = remove_lamps(engine, smooth, surface, volume, self._lamps.lamps)  # B4
                estimate = self._room_light.update(
                    distant, measurement.depth_m, geometry, volume, transfer, self._sampler.rays, indirect
                )
                self._rest.learn(estimate.sh, self._room_light.planes)
        with stage("rendering"):  # 7.1-7.2, the effects this frame calls for
            is_smooth = settings.edges == "smooth"
            view = View(
                engine, camera, geometry.volume_from_camera, settings.reach_m, self._sampler.sampling, is_smooth
            )
            light = upload_light(
                engine, estimate.sh, self._sampler.rays, self._room_light.planes, indirect, geometry.exposure
            )
            averages = None
            if placed and transfer is not None:
                averages = self._averages(geometry, volume, transfer, light, indirect)  # 7.1, H
            if placed:  # 7.2.3
                light = take_discs(engine, light, split_light(estimate.sh), self._sampler.rays, geometry.exposure)
            shown = shown_picture(engine, camera, frame.color, measurement.radiance)
            facts = self._facts.find(
                view,
                geometry,
                volume,
                self._sampler.rays,
                transfer,
                indirect,
                placed,
                light,
                estimate.sh,
                shown,
                averages,
            )
            order, plan = make_plan(
                EFFECTS, "picture", _GIVEN, facts, everything=settings.plan == "everything", stages=left_out
            )
            given = {
                "view": view,
                "objects": placed,
                "volume": volume,
                "rays": self._sampler.rays,
                "real_looks": self._sampler.looks,
                "shown": shown,
                "measurement": measurement,
                "surface": surface,
                "transfer": transfer,
                "indirect": indirect,
                "light": light,
                "averages": averages,
            }
            picture: NDArray[np.uint8] = execute(order, given, "picture")
        if not self._room_light.is_given:  # B4, for the frames to come
            with stage("light_estimation"):
                self._lamps.work(geometry.scene_radiance, surface, volume)

        engine.queue.finish()
        rows, self.kernel_ms = engine.profile.collect()
        return FrameResult(
            color=picture,
            light=self._light_message(frame, geometry, estimate, volume),
            world_from_camera=geometry.world_from_camera,
            tracking=geometry.tracking,
            timings=Timings(**rows, total=(time.perf_counter() - started) * 1e3),
            plan=structs.replace(plan, left_out=(*plan.left_out, *self._lamps.left_out())),
            notes=(*geometry.notes, *_notes(estimate)),
        )

    def _lost(self, frame: RgbdFrame, geometry: GeometryFrame, volume: Volume, started: float) -> FrameResult:
        """The camera's own picture and the last light: where it is not known, nothing can be drawn or learnt."""
        with self._engine.profile.stage("rendering"):
            picture = shown_picture(self._engine, self._camera, frame.color, geometry.measurement.radiance)
        left_out = tuple(LeftOut(effect=e.name, reason="the camera is lost", error_bound=255.0) for e in EFFECTS)
        estimate = self._room_light.estimate()
        self._engine.queue.finish()
        rows, self.kernel_ms = self._engine.profile.collect()
        return FrameResult(
            color=picture,
            light=self._light_message(frame, geometry, estimate, volume),
            world_from_camera=geometry.world_from_camera,
            tracking="lost",
            timings=Timings(**rows, total=(time.perf_counter() - started) * 1e3),
            plan=Plan(run=(), left_out=left_out),
            notes=(*geometry.notes, *_notes(estimate)),
        )

    def _smooth(self, geometry: GeometryFrame) -> cl_array.Array:
        """Radiance that the light is estimated from, denoised as the picture shows it, in the first picture's units."""
        settings = self._settings
        if settings.denoise == "none":
            return geometry.scene_radiance
        smooth = denoise_radiance(self._engine, geometry.measurement, settings.denoise, settings.denoise_iterations)
        return scene_radiance(self._engine, smooth, geometry.exposure, "smooth_scene_radiance")

    def _observe_indirect(self, geometry: GeometryFrame, volume: Volume, transfer: Transfer) -> Indirect | None:
        """What surfaces send one another, if that is wanted."""
        if self._settings.indirect == "none":
            return None
        engine, camera, rays, reach_m = self._engine, self._camera, self._sampler.rays, self._settings.reach_m
        return observe_indirect(engine, camera, volume, geometry.surface, transfer, rays, reach_m)

    def _averages(
        self, geometry: GeometryFrame, volume: Volume, transfer: Transfer, light: DeviceLight, indirect: Indirect | None
    ) -> Averages | None:
        """What pictures and their shading are on average, if virtual things are to match them."""
        asked = self._settings.tone_mapping
        if asked == "light" or (asked == "auto" and self._room_light.is_given):
            return None
        engine, camera, rays, reach_m = self._engine, self._camera, self._sampler.rays, self._settings.reach_m
        radiance, surface = geometry.measurement.radiance, geometry.surface
        frame = measure_averages(engine, camera, radiance, surface, transfer, volume, rays, light, indirect, reach_m)
        return self._average_memory.update(frame, geometry.exposure)

    def _light_message(
        self, frame: RgbdFrame, geometry: GeometryFrame, estimate: LightEstimate, volume: Volume
    ) -> Light:
        lamps, exposure = self._lamps.lamps_at(volume.origin_world), geometry.exposure
        return light_message(frame.index, frame.timestamp_s, estimate, self._webxr_from_world, lamps, exposure)

    def place_object(self, object_id: str, mesh: Mesh, placement: Placement) -> tuple[str, ...]:
        """Put a mesh into the scene, in the place of one with the same id; returns notes. Raises ValueError."""
        if self._objects is None:
            others = [w for w in self._waiting if w[0] != object_id]
            check_room((other for _, other, _ in others), mesh)
            check_size(mesh, placement)
            self._waiting = [*others, (object_id, mesh, placement)]
        else:
            self._objects.place(object_id, mesh, placement)
        return mesh.notes

    def move_object(self, object_id: str, placement: Placement) -> None:
        """Give an object another place. Raises KeyError if there is none of that id."""
        if self._objects is not None:
            self._objects.move(object_id, placement)
            return
        index = self._waiting_index(object_id)
        check_size(self._waiting[index][1], placement)
        self._waiting[index] = (object_id, self._waiting[index][1], placement)

    def remove_object(self, object_id: str) -> None:
        """Take an object away. Raises KeyError if there is none of that id."""
        if self._objects is not None:
            self._objects.remove(object_id)
        else:
            del self._waiting[self._waiting_index(object_id)]

    def set_preset(self, preset: str) -> None:
        """Change the sampling preset from the next frame on. Raises ValueError for one that does not exist."""
        sampling = sampling_of(preset)
        if sampling != self._sampler.sampling:
            self._sampler = self._make_sampler(sampling)
            self._rest = Rest()

    def scene_mesh(self, progress: Callable[[int, int], None] = lambda _done, _total: None) -> SceneMesh:
        """The surface fused so far as triangles. Raises MeshingError, one line, where there is none."""
        volume = self._geometry.volume
        if volume is None:
            raise MeshingError("there is no surface to mesh: no frame has been fused yet")
        bricks = volume.download_bricks()
        bricks = replace(bricks, colors=np.float32(self._geometry.usual_exposure) * bricks.colors)
        return scene_mesh(bricks, volume.voxel_m, volume.origin_world, self._webxr_from_world, progress)

    def close(self) -> None:
        """Give the device's memory back."""
        if self._objects is not None:
            self._objects.clear()
        self._engine.close()

    def _make_sampler(self, sampling: Sampling) -> TransferSampler:
        """Transfer sampled from the start: nothing is remembered from another preset."""
        return TransferSampler(self._engine, self._camera, sampling, self._settings.rays, self._settings.bands)

    def _scene(self, geometry: GeometryFrame) -> tuple[Volume, SceneObjects]:
        """The volume and the objects; the first frame says what is up."""
        volume = self._geometry.volume
        assert volume is not None
        if self._objects is None:
            camera_up, forward = -geometry.world_from_camera[:3, 1], geometry.world_from_camera[:3, 2]
            up = np.array(self._wishes.up or camera_up, np.float64)
            up /= np.linalg.norm(up)
            self._webxr_from_world = webxr_from_world(up, forward)
            given = static_estimate(self._wishes, self._settings.bands, self._webxr_from_world)  # S2
            if given:
                self._room_light.give(given)
            self._objects = SceneObjects(self._engine, up)
            for object_id, mesh, placement in self._waiting:
                self._objects.place(object_id, mesh, placement)
            self._waiting.clear()
        return volume, self._objects

    def _waiting_index(self, object_id: str) -> int:
        names = [name for name, _, _ in self._waiting]
        if object_id not in names:
            raise KeyError(object_id)
        return names.index(object_id)


def _notes(estimate: LightEstimate) -> tuple[str, ...]:
    return ("no usable surface has been seen yet, the light is unknown",) if estimate.std is None else ()


_GIVEN = frozenset(
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
    }
)
