"""The geometry half of the spine (thesis ch. 4): one RGB-D frame folded into the volume, and the surface it shows."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from protocol.frames import CameraModel, RgbdFrame
from protocol.messages import Tracking, Wishes
from server.maths.rigid import repaired_pose
from server.opencl.engine import Engine
from server.settings import bounds_seen, default_voxel_m
from server.stages.integrate import integrate
from server.stages.measure import GREATEST_DEPTH_M, Measurement, measure
from server.stages.merge import merge_depth
from server.stages.raycast import Surface, raycast
from server.stages.volume import Volume


@dataclass(frozen=True)
class GeometryFrame:
    """What one frame gave; arrays are the session's and hold until its next frame."""

    measurement: Measurement
    model: Surface
    """The volume alone, as the camera sees it."""
    surface: Surface
    """The hybrid geometry buffer: the volume, and what changed too fast for it."""
    world_from_camera: NDArray[np.float64]
    volume_from_camera: NDArray[np.float64]
    tracking: Tracking
    notes: tuple[str, ...]
    """What was wrong with this frame, one line each."""


class Geometry:
    """One camera's way into its volume. Owned by one thread."""

    def __init__(self, engine: Engine, camera: CameraModel, wishes: Wishes) -> None:
        self._engine = engine
        self._camera = camera
        self._wishes = wishes
        self.volume: Volume | None = None

    def update(self, frame: RgbdFrame) -> GeometryFrame:
        """Measure, locate, fuse, predict, merge. Raises ValueError, one line, for a frame that is refused."""
        engine, camera, stage = self._engine, self._camera, self._engine.profile.stage
        world_from_camera = self._checked_pose(frame)
        volume = self._scene(frame, world_from_camera)
        volume_from_camera = volume.volume_from_world() @ world_from_camera

        with stage("input"):  # 5.1.1
            measurement = measure(engine, camera, frame)
        with stage("reconstruct"):  # 4.2.1
            volume.allocate(camera, volume_from_camera, measurement.depth_m)
            integrate(engine, volume, camera, volume_from_camera, measurement)
        with stage("surface"):  # 4.2.1
            model = raycast(engine, camera, volume_from_camera, volume)
        with stage("dynamic_geometry"):  # 4.2.2
            surface = merge_depth(engine, camera, volume_from_camera, measurement, model, volume.voxel_m)
        return GeometryFrame(
            measurement, model, surface, world_from_camera, volume_from_camera, "given", self._notes(frame, volume)
        )

    def _checked_pose(self, frame: RgbdFrame) -> NDArray[np.float64]:
        size = (self._camera.height, self._camera.width)
        if frame.color.shape != (*size, 3) or frame.depth.shape != size:
            raise ValueError(
                f"colour is {frame.color.shape[1]}x{frame.color.shape[0]}, depth {frame.depth.shape[1]}x"
                f"{frame.depth.shape[0]}; the camera has {size[1]}x{size[0]}"
            )
        if frame.world_from_camera is None:
            raise ValueError("the frame has no pose, and tracking is not available: use a source with poses")
        return repaired_pose(frame.world_from_camera)

    def _scene(self, frame: RgbdFrame, world_from_camera: NDArray[np.float64]) -> Volume:
        """The volume; made when the first frame says where the scene is."""
        if self.volume is None:
            bounds = self._wishes.volume_m or bounds_seen(self._camera, frame, world_from_camera)
            self.volume = Volume(self._engine, bounds, self._wishes.voxel_m or default_voxel_m(bounds))
        return self.volume

    def _notes(self, frame: RgbdFrame, volume: Volume) -> tuple[str, ...]:
        notes = []
        depth_m = frame.depth * self._camera.depth_scale_m
        if not ((frame.depth > 0) & (frame.depth != 65535) & (depth_m <= GREATEST_DEPTH_M)).any():
            notes.append("the depth picture has no usable value: is the sensor covered?")
        if volume.is_full:
            notes.append("the volume's memory is full, new surface is not fused: give a larger --voxel")
        return tuple(notes)
