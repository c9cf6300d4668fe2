"""One client of a room: its camera's pipeline, its objects, its place in the room, and how finely it samples."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np
from msgspec import structs
from numpy.typing import NDArray

from protocol.frames import CameraModel, RgbdFrame, Viewpoint
from protocol.messages import Hello, PanoramaFormat, Preset, Vector3, Wishes
from server.effects.renderer import RenderRequest
from server.light.panorama_file import encode_panorama
from server.maths.rigid import inverse_rigid
from server.meshing.scene_mesh import SceneMesh
from server.opencl.device import Device
from server.opencl.engine import Engine
from server.pipeline import FrameResult, Pipeline
from server.quality.session_quality import SessionQuality
from server.room.client_objects import ClientObjects
from server.room.room import Room
from server.room.viewpoint import imagined_frame
from server.scene.mesh import Mesh
from server.scene.placement import Placement, SpotPlacement
from server.tracking.alignment import Alignment


class FrameTurn(Protocol):
    """The use of the device for one frame."""

    def is_due(self) -> bool:
        """Whether to let others use the device now, or to give the frame up."""

    def give_way(self, *, may_end: bool) -> None:
        """Returns when the frame may go on. May raise where the frame may be given up."""

    def released(self) -> AbstractContextManager[None]:
        """Context in which others use the device."""


_WITH_NOBODY: AbstractContextManager[FrameTurn | None] = nullcontext()
"""The use of a device that is not shared."""


@dataclass(frozen=True)
class _Yielding:
    """A turn as the pacer of launches asks for it."""

    turn: FrameTurn
    may_end: Callable[[], bool]

    def is_due(self) -> bool:
        return self.turn.is_due()

    def give_way(self) -> None:
        self.turn.give_way(may_end=self.may_end())

    def released(self) -> AbstractContextManager[None]:
        return self.turn.released()


class ClientSession:
    """Owned by one thread; what it shares with other clients is its room's."""

    def __init__(
        self,
        device: Device,
        camera: CameraModel,
        wishes: Wishes,
        room: Room | None = None,
        hello: Hello | None = None,
    ) -> None:
        """`room`: None for one of its own. `hello`: what the client says of its world's place in the room.

        Raises ValueError, one line, for wishes that cannot be met.
        """
        self._room = room or Room(device, wishes)
        self._owns_room = room is None
        self._differences = self._room.differences(wishes)
        wishes = self._room.wishes_of(wishes)
        self._answer, self._is_lossless = wishes.answer, wishes.lossless
        self._quality = SessionQuality(device, wishes)
        self._camera = camera
        self._engine = Engine(device, beside=self._room.engine)
        reconstruction = self._room.reconstruction
        self._alignment = Alignment(self._engine, camera, reconstruction, self._room.markers, hello)
        self._objects = ClientObjects(self._room, self._alignment, camera.width, camera.height)
        self._pipeline = Pipeline(
            self._engine, camera, wishes, self._quality.settings, self._room, self._alignment, self._objects
        )
        self._has_told_pending = False
        self.device_name = device.name

    def process(
        self, frame: RgbdFrame | Viewpoint, *, watched: bool = False, turn: FrameTurn | None = None
    ) -> FrameResult:
        """One frame through the pipeline. A viewpoint shows what others have scanned.

        `watched`: somebody wants the picture, whatever the client wished to be answered by. `turn`: with whom the
        device is shared while the frame is worked on; None: with nobody, and no camera waits. Where one does, and the
        session is not lossless, the light is the newest there is: how new depends on the machine.

        Raises ValueError with one line for a frame that is refused; the session's state is then as it was. Waits while
        another client's frame is in the room. Raises what `turn` raises, after which only `close` may be called.
        """
        with self._room.lock, self._sharing_device(turn):
            if isinstance(frame, Viewpoint):
                volume, place = self._room.reconstruction.volume, self._alignment.room_from_client
                frame = imagined_frame(self._engine, self._camera, volume, frame, place)
            request, waits = RenderRequest(self._answer, watched), turn is None or self._is_lossless
            result = self._pipeline.process_frame(frame, request, waits_for_light=waits)
            plan = result.plan
            if result.tracking != "lost":
                point = self._quality.observe(result.timings, is_reused=result.is_reused)
                self._pipeline.use(self._quality.settings)
                plan = structs.replace(plan, point=point)
            notes = (*result.notes, *self._differences, *self._pending_notes())
            return replace(result, plan=plan, notes=notes, placed=self._objects.take_found())

    @contextmanager
    def _sharing_device(self, turn: FrameTurn | None) -> Iterator[None]:
        pacer = self._engine.pacer
        pacer.yielding = None if turn is None else _Yielding(turn, self._may_end)
        try:
            yield
        except BaseException:
            self._room.changes += 1  # the frame may have changed a part of the room
            raise
        finally:
            pacer.yielding = None

    def _may_end(self) -> bool:
        """Whether the frame can be given up where it is: what it works on is this client's alone."""
        return self._owns_room or self._engine.profile.row == "radiance_transfer"

    def place_object(self, object_id: str, mesh: Mesh, placement: Placement | SpotPlacement) -> tuple[str, ...]:
        """Put a mesh into the room, in place of one with the same id; returns notes. Raises ValueError.

        At a spot, it is placed in the next frame that shows it; that frame's notes say where, or why not.
        """
        with self._room.lock:
            return self._objects.place(object_id, mesh, placement)

    def move_object(self, object_id: str, placement: Placement) -> None:
        """Give an object another place. Raises KeyError if there is none of that id."""
        with self._room.lock:
            self._objects.move(object_id, placement)

    def remove_object(self, object_id: str) -> None:
        """Take an object away. Raises KeyError if there is none of that id."""
        with self._room.lock:
            self._objects.remove(object_id)

    def set_quality(
        self, preset: Preset, budget_ms: float | None = None, max_light_error_deg: float | None = None
    ) -> None:
        """Sample transfer in another way from the next frame on, or as a budget or a light error asks for.

        Raises ValueError for a preset that does not exist, and where the device's front is not known.
        """
        with self._room.lock:
            self._quality.request(preset, budget_ms, max_light_error_deg)
            self._pipeline.use(self._quality.settings)

    def predicted_s(self, preset: Preset) -> float:
        """What a frame at a preset is likely to take at least, before it was measured; 0 for `auto`."""
        return self._quality.predicted_s(preset, self._camera.width, self._camera.height)

    def scene_mesh(self, progress: Callable[[int, int], None] = lambda _done, _total: None) -> SceneMesh:
        """The surface fused so far as triangles. Raises MeshingError, one line, where there is none."""
        return self._room.scene_mesh(self._alignment.webxr_from_room, progress)

    def object_places(self) -> dict[str, NDArray[np.float64]]:
        """world_from_model [4, 4] in the client's world of each object that stands, by its name, in their order."""
        with self._room.lock:
            client_from_room = inverse_rigid(self._alignment.room_from_client)
            standing = [(each.object_id, each.place) for each in self._room.objects.kept()]
        return {name: client_from_room @ place for name, place in standing if isinstance(place, np.ndarray)}

    def panorama(
        self,
        format_: PanoramaFormat,
        position_m: Vector3 | None = None,
        device: AbstractContextManager[FrameTurn | None] = _WITH_NOBODY,
    ) -> tuple[bytes, Vector3]:
        """The light that arrives at a place as a lat-long file, and that place, both in the client's world.

        position_m: None for the first virtual object, else the middle of what the last frame saw. Radiance is in units
        of the last frame's image. device: context in which the device is used; the file is made after it.

        Raises ValueError, one line, before the first frame, and what the turn raises, after which only `close` may be
        called.
        """
        with device as turn, self._room.lock, self._sharing_device(turn):
            asked = None if position_m is None else np.array(position_m, np.float64)
            radiance, (x, y, z) = self._pipeline.light.panorama(asked)
        return encode_panorama(radiance, format_), (float(x), float(y), float(z))

    @property
    def kernel_ms(self) -> dict[str, float]:
        """Milliseconds of each kernel in the last frame."""
        return self._pipeline.kernel_ms

    @property
    def device_bytes(self) -> int:
        """Device memory of this session and its room: arrays and volume; what all sessions share is not counted."""
        return self._engine.bytes_held + self._room.device_bytes

    def close(self) -> None:
        """Give the device's memory back, and the room's where it is this session's alone."""
        with self._room.lock:
            self._engine.close()
        if self._owns_room:
            self._room.close()

    def _pending_notes(self) -> tuple[str, ...]:
        """Once: the objects that were acknowledged before and stand nowhere."""
        if self._has_told_pending:
            return ()
        self._has_told_pending = True
        return self._room.objects.pending_notes(besides=set(self._objects.waiting))
