"""OpenCV 5 on the CPU: Volume (TSDF and HashTSDF) and Odometry, its OpenCL paths off."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from protocol.frames import RgbdFrame
from tests.bench.peers.contestant import (
    GREATEST_DEPTH_M,
    INTEGRATE,
    RAYCAST,
    TRACK,
    TRUNCATION_VOXELS,
    Scene,
    Turn,
)

cv2.ocl.setUseOpenCL(False)


class TsdfVolume:
    """`cv2.Volume`: integrate, and a ray cast that gives vertices and normals in camera axes."""

    def __init__(self, scene: Scene, kind: int) -> None:
        camera = scene.camera
        settings = cv2.VolumeSettings(kind)
        settings.setVoxelSize(scene.voxel_m)
        settings.setTsdfTruncateDistance(TRUNCATION_VOXELS * scene.voxel_m)
        settings.setDepthFactor(1.0 / camera.depth_scale_m)
        settings.setMaxDepth(GREATEST_DEPTH_M)
        if kind == cv2.VolumeType_TSDF:  # of a HashTSDF it would be its blocks' resolution
            settings.setVolumeResolution(np.full(3, scene.voxels_per_side, np.int32))
        pose = np.eye(4, dtype=np.float32)
        pose[:3, 3] = scene.bounds_m[:3]
        settings.setVolumePose(pose)
        settings.setCameraIntegrateIntrinsics(scene.matrix.astype(np.float32))
        settings.setIntegrateWidth(camera.width)
        settings.setIntegrateHeight(camera.height)
        settings.setCameraRaycastIntrinsics(scene.matrix.astype(np.float32))
        settings.setRaycastWidth(camera.width)
        settings.setRaycastHeight(camera.height)
        self._volume = cv2.Volume(kind, settings)

    def process(self, frame: RgbdFrame, turn: Turn) -> None:
        depth, pose = frame.depth.astype(np.float32), _pose(frame)  # HashTSDF refuses uint16
        with turn.clock(INTEGRATE):
            self._volume.integrate(depth, pose)
        with turn.clock(RAYCAST):
            self._volume.raycast(pose)

    def depth(self, frame: RgbdFrame) -> NDArray[np.float32]:
        points, _ = self._volume.raycast(_pose(frame))
        return np.where(np.isfinite(points[..., 2]), points[..., 2], 0).astype(np.float32)


class DenseVolume(TsdfVolume):
    """A dense grid."""

    def __init__(self, scene: Scene) -> None:
        super().__init__(scene, cv2.VolumeType_TSDF)


class HashVolume(TsdfVolume):
    """Blocks in a hash table."""

    def __init__(self, scene: Scene) -> None:
        super().__init__(scene, cv2.VolumeType_HashTSDF)


class DepthOdometry:
    """`cv2.Odometry` on depth alone, frame to frame, its own settings."""

    def __init__(self, scene: Scene) -> None:
        settings = cv2.OdometrySettings()
        settings.setCameraMatrix(scene.matrix.astype(np.float32))
        self._odometry = cv2.Odometry(cv2.ODOMETRY_TYPE_DEPTH, settings, cv2.ODOMETRY_ALGO_TYPE_COMMON)
        self._scale_m = scene.camera.depth_scale_m
        self._pose = scene.start.copy()
        self._before: cv2.OdometryFrame | None = None

    def process(self, frame: RgbdFrame, turn: Turn) -> None:
        depth_m = frame.depth.astype(np.float32) * np.float32(self._scale_m)
        with turn.clock(TRACK):
            now = cv2.OdometryFrame(depth_m)
            self._odometry.prepareFrame(now)
            found, before_from_now = self._odometry.compute(now, self._before) if self._before else (True, np.eye(4))
        if found:
            self._pose = self._pose @ before_from_now
        if self._before is None:
            turn.wall_ms.clear()  # the first frame is not tracked
            turn.cpu_ms.clear()
        self._before = now
        turn.world_from_camera = self._pose.copy()

    def depth(self, frame: RgbdFrame) -> None:  # noqa: ARG002
        return None


def _pose(frame: RgbdFrame) -> NDArray[np.float32]:
    assert frame.world_from_camera is not None
    return frame.world_from_camera.astype(np.float32)
