"""A room: the state that its clients share. One volume, one light, one set of virtual objects, one world (G4, B6)."""

from __future__ import annotations

import threading

from msgspec import structs

from protocol.messages import Wishes
from server.light.lamp_finder import LampFinder
from server.light.room_light import RoomLight
from server.opencl.device import Device
from server.opencl.engine import Engine
from server.quality.sampling_settings import SamplingSettings
from server.quality.settings import read_wishes
from server.room.room_objects import RoomObjects
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
"""Wishes that all clients of a room share: the values of the client that opened it."""


class Room:
    """The caller must hold `lock` while using the room. One frame at a time, from any client."""

    def __init__(self, device: Device, wishes: Wishes, name: str | None = None) -> None:
        """`wishes`: of the client that opens it. `name`: None for the room of one session alone."""
        # Where transfer is sampled is for each client to choose, or to have chosen.
        settings = read_wishes(SamplingSettings().wishes(wishes) if wishes.preset == "auto" else wishes)
        self.name = name
        self.lock = threading.Lock()
        self.engine = Engine(device)
        self.reconstruction = Reconstruction(self.engine, is_shared=name is not None)
        self.light = RoomLight(self.engine, settings)
        self.lamps = LampFinder(self.engine, settings.lamps)
        self.objects = RoomObjects(self.engine)
        self.markers = Markers()
        self.changes = 0
        """Counts what a client that was here before cannot see in its own pictures: others' frames, objects."""
        self.key_digest: bytes | None = None
        """Digest of the room's key (room_registry.py); empty without a key, None until the first client enters."""
        self._wishes = wishes

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

    @property
    def device_bytes(self) -> int:
        """Device memory of the shared state, in bytes."""
        volume = self.reconstruction.volume
        return self.engine.workspace.bytes_held + (volume.device_bytes if volume else 0)

    def close(self) -> None:
        """Free the device memory."""
        self.objects.clear()
        self.engine.close()
