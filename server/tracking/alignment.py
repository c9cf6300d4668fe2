"""Aligns a client's world with the room's: by a given transform, a marker or relocalisation, then refined by depth.

The world of a room is that of the client whose frame was fused first. Frames of a client whose depth contradicts the
room are not fused.
"""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
from numpy.typing import NDArray

from protocol.frames import CameraModel, RgbdFrame
from protocol.messages import Hello, Marker
from server.input.denoise import bilateral_depth
from server.input.measure import Measurement
from server.maths.rigid import inverse_rigid
from server.maths.sh import webxr_from_world
from server.opencl.engine import Engine
from server.scene.placement import Placement
from server.tracking.markers import find_marker
from server.tracking.reconstruction import Reconstruction
from server.tracking.relocalize import fit_near, is_certain, is_near, relocalize, thumbnail
from server.tracking.track import depth_pyramid
from server.volume.volume import Volume

Floats = NDArray[np.float64]

LEAST_OVERLAP = 0.15
"""Least share of the picture that must show the room's surface for a comparison."""
LEAST_SHARE, GREATEST_DEVIATION_M = 0.4, 0.015
"""Least share of the compared pixels that must fit, and the greatest deviation, as in tracking; else the frame
contradicts the room."""
GREATEST_CORRECTION_M, GREATEST_CORRECTION_RAD = 0.3, np.radians(15.0)
"""Greatest correction by depth of a pose that the client or a marker gives."""
CERTAIN_FRAMES = 5
"""Number of corrections that are averaged, from frames that fix all motions."""


class Markers:
    """Poses of the markers of one room, by dictionary and number."""

    def __init__(self) -> None:
        self._places: dict[tuple[str, int], Floats] = {}

    def place_of(self, marker: Marker) -> Floats | None:
        """room_from_marker [4, 4]; None if no aligned client has seen the marker."""
        return self._places.get((marker.dictionary, marker.id))

    def places(self) -> dict[tuple[str, int], Floats]:
        """room_from_marker [4, 4] of all markers, by dictionary and number."""
        return dict(self._places)

    def resume(self, places: dict[tuple[str, int], Floats]) -> None:
        """Restore saved poses."""
        self._places = dict(places)

    def note(self, marker: Marker, room_from_marker: Floats) -> None:
        """Add a marker's pose; the first one is kept."""
        self._places.setdefault((marker.dictionary, marker.id), room_from_marker)


class Alignment:
    """Alignment of one client."""

    def __init__(
        self,
        engine: Engine,
        camera: CameraModel,
        reconstruction: Reconstruction,
        markers: Markers,
        hello: Hello | None = None,
    ) -> None:
        """`hello`: says where the client's world lies in the room; None: it is the room's."""
        self._engine = engine
        self._camera = camera
        self._reconstruction = reconstruction
        self._markers = markers
        self._marker = hello.marker if hello else None
        given = hello.room_from_world if hello else None
        self._given = None if given is None else np.array(given, np.float64).reshape(4, 4)
        self._is_first = False
        """Whether its world became the room's."""
        self._corrections = 0
        self._sightings = 0
        self.room_from_client: Floats = np.eye(4) if self._given is None else self._given
        self._is_alone = hello is None or hello.room is None
        self.is_settled = self._is_alone
        """Whether to fuse the client's frames."""
        self.webxr_from_client: Floats | None = None
        """[3, 3] rotation into axes with +y up and the first view as close to -z as possible; None before a frame."""
        self._up: Floats | None = None
        """Of `webxr_from_client`, in the room."""
        self._first_view = np.zeros(3)
        """Direction in the client's world."""

    def in_room(self, frame: RgbdFrame) -> RgbdFrame:
        """The frame with its pose in the room's world; a missing pose is computed from a marker if one is seen."""
        if frame.world_from_camera is not None:
            if self._is_alone:
                return frame
            return replace(frame, world_from_camera=self.room_from_client @ frame.world_from_camera)
        place = self._markers.place_of(self._marker) if self._marker else None
        if self._marker is None or place is None:
            return frame
        try:
            camera_from_marker = find_marker(_gray(frame), self._camera, self._marker)
        except ValueError:
            return frame  # not in this picture
        return replace(frame, world_from_camera=place @ inverse_rigid(camera_from_marker))

    @property
    def is_identity(self) -> bool:
        """Whether the client's world is the room's."""
        return bool((self.room_from_client == np.eye(4)).all())

    @property
    def client_from_room(self) -> Floats:
        """[4, 4] rigid."""
        return inverse_rigid(self.room_from_client)

    @property
    def webxr_from_room(self) -> Floats | None:
        """[3, 3]; None before a frame."""
        return None if self.webxr_from_client is None else self.webxr_from_client @ self.client_from_room[:3, :3]

    def note_view(self, up: Floats, room_from_camera: Floats) -> None:
        """Derive `webxr_from_client` from a view until the client's place in the room is settled, and from the first
        view where up has changed. up: [3] unit, in the room."""
        rotation = self.client_from_room[:3, :3]
        if self._up is None or not self.is_settled:
            self._first_view = rotation @ room_from_camera[:3, 2]
        elif (up == self._up).all():
            return
        self._up = up
        self.webxr_from_client = webxr_from_world(rotation @ up, self._first_view)

    def in_client(self, room_from_camera: Floats) -> Floats:
        """A camera pose in the client's world."""
        return room_from_camera if self.is_identity else self.client_from_room @ room_from_camera

    def placed(self, placement: Placement) -> Placement:
        """A placement given in the client's world, for the room."""
        return placement if self.is_identity else replace(placement, room_from_client=self.room_from_client)

    def settle(self, frame: RgbdFrame, measurement: Measurement) -> str | None:
        """Align by one frame. Returns why that failed, one line; None if the client is aligned.

        A frame without a pose is located in the room by tracking and needs no alignment.
        """
        if self._is_alone or frame.world_from_camera is None:
            return None
        volume = self._reconstruction.volume
        if not frame.has_depth:
            return self._settle_without_depth(frame, measurement)
        if volume is None or volume.frames == 0:
            self._is_first = self.is_settled = True
        elif not self._is_first and self._corrections < CERTAIN_FRAMES:
            problem = self._fit(frame, measurement, volume)
            if problem is not None and not self.is_settled:
                return f"not aligned with the room, nothing is fused: {problem}"
            self.is_settled = True
        if self._marker is not None and self._markers.place_of(self._marker) is None:
            self._note_marker(frame, measurement, self._marker)
        return None

    def _settle_without_depth(self, frame: RgbdFrame, measurement: Measurement) -> str | None:
        """Align by the given transform or a marker alone."""
        try:
            self.is_settled = self._is_given(frame, measurement) or self.is_settled
        except ValueError as error:
            if not self.is_settled:
                return f"not aligned with the room: {error}"
        if self.is_settled:
            return None
        return "not aligned with the room: without depth, say where its world lies, or show a common marker"

    def _fit(self, frame: RgbdFrame, measurement: Measurement, volume: Volume) -> str | None:
        """Refine the alignment by a frame's depth. Returns why the frame contradicts the room; None if it does not."""
        assert frame.world_from_camera is not None
        engine, camera, to_volume = self._engine, self._camera, volume.volume_from_world()
        try:
            is_given = self._corrections > 0 or self._is_given(frame, measurement)
        except ValueError as error:
            return str(error)
        pyramid = depth_pyramid(engine, camera, bilateral_depth(engine, measurement.depth_m))
        pose = to_volume @ self.room_from_client @ frame.world_from_camera
        if is_given:
            found = fit_near(engine, camera, volume, pyramid, pose)
            if found is None or found.overlap < LEAST_OVERLAP:
                return None  # the camera looks elsewhere: nothing contradicts its pose
            fits = found.share > LEAST_SHARE and found.deviation_m < GREATEST_DEVIATION_M
            if not fits or not is_near(found.volume_from_camera, pose, GREATEST_CORRECTION_M, GREATEST_CORRECTION_RAD):
                return "its depth does not fit the room's surface at the given pose"
        else:
            seen = thumbnail(frame, engine.download(pyramid[0]))
            places = [pose, *self._reconstruction.keyframes.most_similar(seen, count=3)]
            found = relocalize(engine, camera, volume, pyramid, places)
            if found is None:
                return "it does not show what the room has seen: say where its world lies, or show a common marker"
        if is_certain(found):
            self._corrections += 1
            room_from_camera = inverse_rigid(to_volume) @ found.volume_from_camera
            self._average(room_from_camera @ inverse_rigid(frame.world_from_camera), self._corrections)
        return None

    def _is_given(self, frame: RgbdFrame, measurement: Measurement) -> bool:
        """Whether a transform or marker gives the alignment. Raises ValueError if the marker is hidden or unknown."""
        place = self._markers.place_of(self._marker) if self._marker else None
        if self._marker is None or (place is None and self._given is not None):
            return self._given is not None
        if place is None:
            raise ValueError(f"nobody in the room has seen marker {self._marker.id}")
        measured = place @ inverse_rigid(self._world_from_marker(frame, measurement, self._marker))
        self._sightings += 1
        self._average(measured, self._sightings)
        return True

    def _average(self, measured: Floats, count: int) -> None:
        """Update room_from_client to the mean of `count` measurements, of which `measured` is the newest."""
        mixed = self.room_from_client + (measured - self.room_from_client) / count
        u, _, vt = np.linalg.svd(mixed[:3, :3])
        mixed[:3, :3] = u @ vt
        self.room_from_client = mixed

    def _note_marker(self, frame: RgbdFrame, measurement: Measurement, marker: Marker) -> None:
        try:
            self._markers.note(marker, self.room_from_client @ self._world_from_marker(frame, measurement, marker))
        except ValueError:
            return  # not in this picture

    def _world_from_marker(self, frame: RgbdFrame, measurement: Measurement, marker: Marker) -> Floats:
        """In the client's world. Raises ValueError, one line, unless the picture shows the marker."""
        assert frame.world_from_camera is not None
        depth_m = self._engine.download(measurement.depth_m)
        return np.asarray(frame.world_from_camera @ find_marker(_gray(frame), self._camera, marker, depth_m))


def _gray(frame: RgbdFrame) -> NDArray[np.uint8]:
    color = frame.color if frame.color.dtype == np.uint8 else (frame.color >> 8).astype(np.uint8)
    return np.asarray(cv2.cvtColor(color, cv2.COLOR_RGB2GRAY), np.uint8)
