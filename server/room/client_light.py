"""A room's light as one client adds to it and is told of it."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import pyopencl.cltypes as cl_types
from numpy.typing import NDArray
from pyopencl.array import Array

from protocol.frames import RgbdFrame
from protocol.messages import Light, Vector3
from server.culling.reason import CullReason
from server.frame_context import FrameContext
from server.input.denoise import denoise_radiance
from server.light.light_estimation import LightEstimate
from server.light.light_message import light_message, seen_from
from server.light.near_light import remove_lamps
from server.light.panorama_file import lat_long_radiance
from server.light.told_places import MOST_OBJECTS, ToldPlaces
from server.opencl.buffers import BufferDescription, StageBuffers
from server.opencl.engine import Engine
from server.quality.settings import Settings
from server.room.room import Room
from server.tracking.alignment import Alignment
from server.tracking.exposure import scene_radiance
from server.transfer.samples import TransferSamples
from server.volume.volume import Volume

Floats = NDArray[np.float64]


class _Buffers(StageBuffers):
    smooth_radiance = BufferDescription(cl_types.float4)
    """[h, w] denoised, in the first picture's units."""


class ClientLight:
    """Adds a client's frames to the light of its room, and tells the client that light in the client's own world."""

    def __init__(self, engine: Engine, room: Room, alignment: Alignment, light_at: tuple[Vector3, ...]) -> None:
        """`alignment`: of the client's world with the room's. `light_at`: places of the client's world, metres."""
        self._engine = engine
        self._room = room
        self._alignment = alignment
        self._light_at = np.array(light_at, np.float64).reshape(-1, 3)
        self._places = ToldPlaces()
        self._exposure = 1.0

    def begin(self, context: FrameContext, *, is_learnt: bool) -> None:
        """Let the device gather what `update` needs of a frame. `is_learnt`: the frame adds to the light."""
        if is_learnt:
            self._room.light.begin(context)
        self._places.begin(context)

    def update(
        self,
        context: FrameContext,
        samples: TransferSamples,
        settings: Settings,
        left_out: Mapping[str, CullReason],
        *,
        is_still: bool,
    ) -> LightEstimate:
        """The light with this frame, or as it stands; what arrives at the client's places is looked up anew.

        `is_still`: the geometry is that of the frame before.
        """
        place = self._alignment.room_from_client
        asked = self._light_at @ place[:3, :3].T + place[:3, 3]
        self._places.look_up(context, self._room.light, asked, self._room.objects.middles())
        if "estimate_light" in left_out:
            light = self._room.light.estimate()
        else:
            radiance, lamps = self._denoised(context, settings), self._room.lamps.lamps
            distant = remove_lamps(self._engine, radiance, context.surface, context.volume, lamps)  # B4
            light = self._room.light.update(context, distant, samples, self._room.objects.up)
        self._places.update(context, self._room.light, is_still=is_still)
        self._room.light.finish()
        return light

    def _denoised(self, context: FrameContext, settings: Settings) -> Array:
        """[h, w] float4: what the light is estimated from, in the first picture's units."""
        if settings.denoise == "none":
            return context.scene_radiance
        smooth = denoise_radiance(self._engine, context.measurement, settings.denoise, settings.denoise_iterations)
        return scene_radiance(self._engine, smooth, context.exposure, self._engine.buffers(_Buffers).smooth_radiance)

    def message(self, frame: RgbdFrame, light: LightEstimate, volume: Volume, exposure: float) -> Light:
        """The light in the client's world. `exposure`: of the frame."""
        lamps, axes = self._room.lamps.lamps_at(volume.origin_world), self._alignment.webxr_from_client
        assert axes is not None
        self._exposure, places = exposure, self._places.newest
        if not self._alignment.is_identity:
            light, lamps = seen_from(self._alignment.client_from_room, light, lamps)
            places = places.seen_from(self._alignment.client_from_room)
        return light_message(frame.index, frame.timestamp_s, light, axes, lamps, exposure, places)

    def notes(self, light: LightEstimate) -> tuple[str, ...]:
        """What is not known of the light, and of the places where it was asked for."""
        unknown = ("no usable surface has been seen yet, the light is unknown",) if light.std is None else ()
        count = len(self._room.objects.middles())
        if count <= MOST_OBJECTS:
            return unknown
        return (*unknown, f"{count} objects: only the first {MOST_OBJECTS} are told a light of their own")

    def panorama(self, position: Floats | None) -> tuple[Floats, Floats]:
        """[h, w, 3] radiance that arrives at a place, in units of the last frame's image, and the place [3].

        Both are of the client's world; position None: the first object's, else the middle of the last view. Rows and
        columns are those of `panorama_directions` in WebXR's axes. Raises ValueError, one line, before a frame.
        """
        room, alignment, volume = self._room, self._alignment, self._room.reconstruction.volume
        to_webxr, view = alignment.webxr_from_room, self._places.newest.view
        if volume is None or to_webxr is None or view is None:
            raise ValueError("there is no light yet: no frame has been placed in the room")
        if position is None:
            where = next(iter(room.objects.middles().values()), view)
        else:
            where = alignment.room_from_client[:3, :3] @ position + alignment.room_from_client[:3, 3]
        radiance = lat_long_radiance(
            lambda directions: room.light.radiance_at(self._engine, volume, where, directions), to_webxr
        )
        to_client = alignment.client_from_room
        return self._exposure * radiance, to_client[:3, :3] @ where + to_client[:3, 3]
