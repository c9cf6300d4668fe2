"""The geometry steps of a frame (thesis ch. 4): tracking, fusion into the volume, and the visible surface."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import pyopencl.array as cl_array
import pyopencl.cltypes as cl_types
from numpy.typing import NDArray

from protocol.frames import CameraModel, RgbdFrame
from protocol.messages import Tracking, Wishes
from server.geometry.merge import merge_depth
from server.input.measure import GREATEST_DEPTH_M, Measurement, measure
from server.opencl.buffers import BufferDescription, StageBuffers
from server.opencl.engine import Engine
from server.opencl.pending_read import PendingRead
from server.tracking.camera_tracking import CameraTracking, PoseEstimate
from server.tracking.exposure import ExposureTracking, scene_radiance
from server.tracking.reconstruction import Reconstruction
from server.volume.integrate import integrate
from server.volume.raycast import Surface, raycast
from server.volume.volume import Volume


class _Buffers(StageBuffers):
    scene_radiance = BufferDescription(cl_types.float4)
    """[h, w] as in GeometryFrame."""


@dataclass(frozen=True)
class GeometryFrame:
    """Geometry of one frame. Its arrays are valid until the session's next frame."""

    measurement: Measurement
    exposure: float
    """Exposure of the picture relative to the session's first."""
    scene_radiance: cl_array.Array
    """`measurement.radiance` over `exposure`: in the units of the first picture."""
    model: Surface
    """The volume's surface as seen by the camera."""
    surface: Surface
    """The hybrid geometry buffer: the volume's surface merged with the measured depth."""
    world_from_camera: NDArray[np.float64]
    volume_from_camera: NDArray[np.float64]
    tracking: Tracking
    """If it is lost, pose and surfaces are those of the last good frame."""
    notes: tuple[str, ...]
    """Problems with this frame, one line each."""
    is_reused: bool = False
    """Whether pose and surfaces were kept from the frame before, since nothing has changed."""


class Geometry:
    """Geometry of one camera. Owned by one thread."""

    def __init__(
        self, engine: Engine, camera: CameraModel, wishes: Wishes, reconstruction: Reconstruction | None = None
    ) -> None:
        """`reconstruction`: shared with other cameras; None: one of its own."""
        self._engine, self._buffers = engine, _Buffers(engine.workspace)
        self._camera = camera
        self._wishes = wishes
        self._reconstruction = reconstruction or Reconstruction(engine)
        self._tracking = CameraTracking(engine, camera, wishes.poses, self._reconstruction)
        self._exposure = ExposureTracking(engine, camera, "constant" if wishes.as_thesis else wishes.exposure)
        self._last: GeometryFrame | None = None

    @property
    def volume(self) -> Volume | None:
        """None before the first frame."""
        return self._reconstruction.volume

    def scan(self, frame: RgbdFrame) -> GeometryFrame:
        """All steps for one frame of a camera that scans alone. Raises ValueError for a frame that is refused."""
        check_size(self._camera, frame)
        volume = self.volume_for(frame)
        with self._engine.profile.stage("input"):
            measurement = measure(self._engine, self._camera, frame)
        return self.update(frame, measurement, volume)

    def volume_for(self, frame: RgbdFrame) -> Volume:
        """The volume into which to fuse a frame; created by the first frame. frame: its pose is in the room's world.

        Raises ValueError, one line, for a frame that is refused; the state is then unchanged.
        """
        guess = self._tracking.first_guess(frame)
        return self._reconstruction.volume_for(self._wishes, self._camera, frame, guess)

    def keep(self, frame: RgbdFrame, measurement: Measurement, volume: Volume) -> GeometryFrame:
        """The geometry of the frame before, for a still view. The frame is fused nevertheless, so that the volume does
        not depend on reuse."""
        assert self._last is not None
        last = self._last
        with self._engine.profile.stage("reconstruct"):
            scene = self._scene_radiance(measurement, last.exposure)
            self._fuse(volume, last.volume_from_camera, Measurement(scene, measurement.depth_m), last.exposure)
        notes = input_notes(self._camera, frame, volume)
        return replace(last, measurement=measurement, scene_radiance=scene, notes=notes, is_reused=True)

    def update(
        self, frame: RgbdFrame, measurement: Measurement, volume: Volume, unaligned: str | None = None
    ) -> GeometryFrame:
        """Locate, fuse, ray cast, merge. unaligned: why the frame is not aligned with the room; None: it is."""
        engine, camera, stage = self._engine, self._camera, self._engine.profile.stage
        with stage("reconstruct"):  # 4.2.1
            located = self._locate(frame, measurement, volume, unaligned)
            volume_from_camera = volume.volume_from_world() @ located.world_from_camera
            place = volume_from_camera if located.fuse else None
            marked = None  # found before the exposure, so that the host waits once for both
            if located.fuse and frame.has_depth:
                marked = volume.mark_near(camera, volume_from_camera, measurement.depth_m)
            exposure, doubts = self._exposure.update(frame, measurement, volume, place)  # B3
            scene = self._scene_radiance(measurement, exposure)
            notes = (*located.notes, *doubts, *input_notes(camera, frame, volume))
            if self._last is not None and not located.fuse:
                lost = replace(self._last, measurement=measurement, exposure=exposure, scene_radiance=scene)
                return replace(lost, tracking=located.tracking, notes=notes)
            if marked is not None:
                self._fuse(volume, volume_from_camera, Measurement(scene, measurement.depth_m), exposure, marked)
        with stage("surface"):  # 4.2.1
            model = raycast(engine, camera, volume_from_camera, volume)
            if located.fuse:
                self._tracking.remember(frame, located, model, volume_from_camera)
        with stage("dynamic_geometry"):  # 4.2.2
            smooth = self._wishes.smooth_depth
            surface = merge_depth(engine, camera, volume_from_camera, measurement, model, volume, smooth)
        result = GeometryFrame(
            measurement=measurement,
            exposure=exposure,
            scene_radiance=scene,
            model=model,
            surface=surface,
            world_from_camera=located.world_from_camera,
            volume_from_camera=volume_from_camera,
            tracking=located.tracking,
            notes=notes,
        )
        self._last = result if located.fuse else None
        return result

    def _locate(
        self, frame: RgbdFrame, measurement: Measurement, volume: Volume, unaligned: str | None
    ) -> PoseEstimate:
        if unaligned is None:
            return self._tracking.locate(frame, measurement, volume)
        return PoseEstimate(self._tracking.first_guess(frame), "lost", (unaligned,))

    def _scene_radiance(self, measurement: Measurement, exposure: float) -> cl_array.Array:
        return scene_radiance(self._engine, measurement.radiance, exposure, self._buffers.scene_radiance)

    def _fuse(
        self,
        volume: Volume,
        volume_from_camera: NDArray[np.float64],
        measured: Measurement,
        exposure: float,
        marked: PendingRead | None = None,
    ) -> None:
        volume.allocate(self._camera, volume_from_camera, measured.depth_m, marked)
        integrate(self._engine, volume, self._camera, volume_from_camera, measured)
        self._reconstruction.count_exposure(exposure)


def check_size(camera: CameraModel, frame: RgbdFrame) -> None:
    """Raises ValueError, one line, for images that do not have the camera's size and types."""
    depth = camera.depth_lens
    if frame.color.shape != (camera.height, camera.width, 3) or frame.depth.shape != (depth.height, depth.width):
        raise ValueError(
            f"colour is {frame.color.shape[1]}x{frame.color.shape[0]}, depth {frame.depth.shape[1]}x"
            f"{frame.depth.shape[0]}; the camera has {camera.width}x{camera.height} and {depth.width}x{depth.height}"
        )
    color_type = "uint16" if camera.color_encoding == "linear16" else "uint8"
    if frame.color.dtype != color_type or frame.depth.dtype != "uint16":
        raise ValueError(
            f"colour is of type {frame.color.dtype}, depth of {frame.depth.dtype}; "
            f"{camera.color_encoding} is {color_type}, depth uint16 in units of depth_scale_m"
        )


def input_notes(camera: CameraModel, frame: RgbdFrame, volume: Volume) -> tuple[str, ...]:
    """Problems with a frame's depth or the volume's memory, one line each."""
    notes = []
    sparse = frame.depth[::16, ::16]  # mostly a few pixels are enough
    if frame.has_depth and not any(_is_usable(camera, depth).any() for depth in (sparse, frame.depth)):
        notes.append("the depth picture has no usable value: is the sensor covered?")
    if volume.is_full:
        notes.append("the volume's memory is full, new surface is not fused: give a larger --voxel")
    return tuple(notes)


def _is_usable(camera: CameraModel, depth: NDArray[np.uint16]) -> NDArray[np.bool_]:
    usable: NDArray[np.bool_] = (depth > 0) & (depth != 65535) & (depth * camera.depth_scale_m <= GREATEST_DEPTH_M)
    return usable
