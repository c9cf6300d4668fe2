"""A room: the state that its clients share. One volume, one light, one set of virtual objects, one world (G4, B6)."""

from __future__ import annotations

import threading
from collections.abc import Callable
from dataclasses import replace
from typing import Literal

import numpy as np
from msgspec import structs
from numpy.typing import NDArray

from protocol.messages import Wishes
from server.geometry.geometry import GeometryFrame
from server.light.lamp_finder import LampFinder
from server.light.room_light import RoomLight
from server.light.static_light import static_estimate
from server.maths.sh import webxr_from_world
from server.meshing.scene_mesh import SceneMesh, scene_mesh
from server.meshing.surface import MeshingError
from server.opencl.device import Device
from server.opencl.engine import Engine
from server.quality.sampling_settings import SamplingSettings
from server.quality.settings import Settings, read_wishes
from server.room.room_objects import RoomObjects
from server.room.up_finder import UpFinder
from server.tracking.alignment import Markers
from server.tracking.reconstruction import Reconstruction

SHARED = (
    "volume_m",
    "voxel_m",
    "up",
    "bands",
    "albedo",
    "indirect",
    "as_thesis",
    "light",
    "light_axes",
    "light_color",
    "lamps",
    "robustness",
)
"""Wishes that all clients of a room share, with the values of the client that opened it."""


class Room:
    """The caller must hold `lock` while using the room. One frame at a time, from any client."""

    def __init__(self, device: Device, wishes: Wishes, name: str | None = None) -> None:
        """`wishes`: those of the client that opens the room. `name`: None for the room of a single session."""
        # Each client has sampling settings of its own.
        settings = read_wishes(SamplingSettings().wishes(wishes) if wishes.preset == "auto" else wishes)
        self.name = name
        self.lock = threading.Lock()
        self.engine = Engine(device)
        self.reconstruction = Reconstruction(self.engine, is_shared=name is not None)
        self.light = RoomLight(settings)
        self.lamps = LampFinder(self.engine, self._wants_lamps(settings))
        self.objects = RoomObjects(self.engine)
        self.markers = Markers()
        self.changes = 0
        """Counts the frames of all clients, and objects placed or removed."""
        self.key_digest: bytes | None = None
        """Digest of the room's key (room_registry.py); empty without a key, None until the first client enters."""
        self._wishes = wishes
        self._up_finder = UpFinder(None if wishes.up is None else np.array(wishes.up) / np.linalg.norm(wishes.up))
        self._first_view = np.zeros(3)
        """[3] world: direction of the first frame's view."""

    def _wants_lamps(self, settings: Settings) -> Literal["auto", "on", "off"]:
        """The model of the room has its own lamps, on its shell: only one light for all places lacks them."""
        is_needed = settings.lamps != "auto" or self.light.estimates_one_light
        return settings.lamps if is_needed else "off"

    @property
    def wishes(self) -> Wishes:
        """Wishes of the client that opened the room."""
        return self._wishes

    def wishes_of(self, wishes: Wishes) -> Wishes:
        """A client's wishes, with the shared ones replaced by the room's."""
        return structs.replace(wishes, **{name: getattr(self._wishes, name) for name in SHARED})

    def differences(self, wishes: Wishes) -> tuple[str, ...]:
        """One line for each wish of a client that the room overrides."""
        return tuple(
            f"{name.removesuffix('_m').replace('_', '-')} is as the client that opened room {self.name!r} asked"
            for name in SHARED
            if getattr(wishes, name) != getattr(self._wishes, name)
        )

    def orient(self, engine: Engine, geometry: GeometryFrame, bands: int, *, has_surface: bool) -> tuple[str, ...]:
        """Set what is up, and with it the axes of a given light (S2), by one frame. Returns notes.

        `has_surface`: whether the frame has depth, a pose, and nothing of it is reused from the last one. The first
        frame sets up in any case; see UpFinder for what the next ones do.
        """
        world_from_camera = geometry.world_from_camera
        notes = self._up_finder.look(engine, geometry.surface if has_surface else None, world_from_camera)
        up = self._up_finder.up
        if not self.objects.has_begun:
            self._first_view = world_from_camera[:3, 2].copy()
            self.objects.begin(up)
        elif (up == self.objects.up).all():
            return notes
        else:
            self.objects.set_up(up)
        given = static_estimate(self._wishes, bands, webxr_from_world(up, self._first_view))
        if given:
            self.light.give(given)
        return notes

    def resume_up(self, up: NDArray[np.float64]) -> None:
        """Restore a saved up direction [3], which then stays."""
        self._up_finder = UpFinder(up)
        self.objects.begin(up)

    def scene_mesh(
        self,
        gltf_from_world: NDArray[np.float64] | None,
        progress: Callable[[int, int], None] = lambda _done, _total: None,
    ) -> SceneMesh:
        """The surface fused so far as triangles. Takes the lock while the volume is copied.

        gltf_from_world: [3, 3], None before the first frame. Raises MeshingError, one line, if there is no surface.
        """
        with self.lock:
            volume, exposure = self.reconstruction.volume, self.reconstruction.usual_exposure
            if volume is None or gltf_from_world is None:
                raise MeshingError("there is no surface to mesh: no frame has been fused yet")
            bricks = volume.download_bricks()
        bricks = replace(bricks, colors=np.float32(exposure) * bricks.colors)
        return scene_mesh(bricks, volume.voxel_m, volume.origin_world, gltf_from_world, progress)

    @property
    def device_bytes(self) -> int:
        """Device memory of the shared state, in bytes."""
        return self.engine.bytes_held

    def close(self) -> None:
        """Free the device memory."""
        self.objects.clear()
        self.light.close()
        self.engine.close()
