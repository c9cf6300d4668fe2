"""Open3D on the CPU: VoxelBlockGrid, UniformTSDFVolume and the frame-to-model tracking of its dense SLAM."""

from __future__ import annotations

import numpy as np
import open3d as o3d
from numpy.typing import NDArray

from protocol.frames import RgbdFrame
from tests.bench.peers.contestant import (
    GREATEST_DEPTH_M,
    INTEGRATE,
    LEAST_DEPTH_M,
    RAYCAST,
    TRACK,
    TRUNCATION_VOXELS,
    Scene,
    Turn,
)

CPU = o3d.core.Device("CPU:0")
BLOCKS = 40_000
"""Its table's first size: large enough that no frame pays for making it larger."""
LEAST_WEIGHT = 1.0
GREATEST_STEP_M = 0.07
"""Its own default of how far apart paired points may be."""

o3d.utility.set_verbosity_level(o3d.utility.VerbosityLevel.Error)


class BlockGrid:
    """`t.geometry.VoxelBlockGrid`: allocate, integrate depth, cast vertices and normals from the frame's blocks."""

    def __init__(self, scene: Scene, side: int) -> None:
        self._scene = scene
        self._scale = 1.0 / scene.camera.depth_scale_m
        self._matrix = o3d.core.Tensor(scene.matrix)
        kinds = [o3d.core.float32, o3d.core.float32]
        self._grid = o3d.t.geometry.VoxelBlockGrid(
            ["tsdf", "weight"], kinds, [(1,), (1,)], scene.voxel_m, side, BLOCKS, CPU
        )

    def process(self, frame: RgbdFrame, turn: Turn) -> None:
        picture = o3d.t.geometry.Image(o3d.core.Tensor(frame.depth))
        view = o3d.core.Tensor(_camera_from_world(frame))
        with turn.clock(INTEGRATE):
            blocks = self._grid.compute_unique_block_coordinates(
                picture, self._matrix, view, self._scale, GREATEST_DEPTH_M, TRUNCATION_VOXELS
            )
            self._grid.integrate(blocks, picture, self._matrix, view, self._scale, GREATEST_DEPTH_M, TRUNCATION_VOXELS)
        with turn.clock(RAYCAST):
            self._cast(blocks, view)

    def depth(self, frame: RgbdFrame) -> NDArray[np.float32]:
        picture = o3d.t.geometry.Image(o3d.core.Tensor(frame.depth))
        view = o3d.core.Tensor(_camera_from_world(frame))
        blocks = self._grid.compute_unique_block_coordinates(
            picture, self._matrix, view, self._scale, GREATEST_DEPTH_M, TRUNCATION_VOXELS
        )
        return np.array(self._cast(blocks, view)["vertex"].numpy()[..., 2], np.float32)

    def _cast(self, blocks: o3d.core.Tensor, view: o3d.core.Tensor) -> dict[str, o3d.core.Tensor]:
        camera = self._scene.camera
        found: dict[str, o3d.core.Tensor] = self._grid.ray_cast(
            blocks,
            self._matrix,
            view,
            camera.width,
            camera.height,
            ["vertex", "normal"],
            self._scale,
            LEAST_DEPTH_M,
            GREATEST_DEPTH_M,
            LEAST_WEIGHT,
            TRUNCATION_VOXELS,
        )
        return found


class BlockGrid8(BlockGrid):
    """Blocks as large as this program's bricks."""

    def __init__(self, scene: Scene) -> None:
        super().__init__(scene, 8)


class BlockGrid16(BlockGrid):
    """Blocks as large as Open3D's tutorials and its dense SLAM make them."""

    def __init__(self, scene: Scene) -> None:
        super().__init__(scene, 16)


class UniformVolume:
    """`pipelines.integration.UniformTSDFVolume`, which has no ray casting: its mesh is looked at instead."""

    def __init__(self, scene: Scene) -> None:
        camera = scene.camera
        self._scene = scene
        self._intrinsics = o3d.camera.PinholeCameraIntrinsic(
            camera.width, camera.height, camera.fx, camera.fy, camera.cx, camera.cy
        )
        self._volume = o3d.pipelines.integration.UniformTSDFVolume(
            length=scene.voxel_m * scene.voxels_per_side,
            resolution=scene.voxels_per_side,
            sdf_trunc=TRUNCATION_VOXELS * scene.voxel_m,
            color_type=o3d.pipelines.integration.TSDFVolumeColorType.NoColor,
            origin=np.array(scene.bounds_m[:3]),
        )

    def process(self, frame: RgbdFrame, turn: Turn) -> None:
        picture = o3d.geometry.RGBDImage.create_from_color_and_depth(
            o3d.geometry.Image(np.zeros((*frame.depth.shape, 3), np.uint8)),
            o3d.geometry.Image(frame.depth),
            depth_scale=1.0 / self._scene.camera.depth_scale_m,
            depth_trunc=GREATEST_DEPTH_M,
            convert_rgb_to_intensity=False,
        )
        with turn.clock(INTEGRATE):
            self._volume.integrate(picture, self._intrinsics, _camera_from_world(frame))

    def depth(self, frame: RgbdFrame) -> NDArray[np.float32]:
        camera = self._scene.camera
        meshes = o3d.t.geometry.RaycastingScene()
        meshes.add_triangles(o3d.t.geometry.TriangleMesh.from_legacy(self._volume.extract_triangle_mesh()))
        rays = meshes.create_rays_pinhole(self._scene.matrix, _camera_from_world(frame), camera.width, camera.height)
        distance = meshes.cast_rays(rays)["t_hit"].numpy()  # in lengths of the ray, whose z is 1
        return np.where(np.isfinite(distance), distance, 0).astype(np.float32)


class ModelTracking:
    """`t.pipelines.slam.Model`: a frame against the ray cast model, then the model grown at the pose found."""

    def __init__(self, scene: Scene, method: o3d.t.pipelines.odometry.Method, has_color: bool) -> None:
        camera = scene.camera
        self._scene, self._method, self._has_color = scene, method, has_color
        self._scale = 1.0 / camera.depth_scale_m
        self._pose = scene.start.copy()
        self._count = 0
        slam = o3d.t.pipelines.slam
        self._model = slam.Model(scene.voxel_m, 16, BLOCKS, o3d.core.Tensor(self._pose), CPU)
        matrix = o3d.core.Tensor(scene.matrix)
        self._seen = slam.Frame(camera.height, camera.width, matrix, CPU)
        self._predicted = slam.Frame(camera.height, camera.width, matrix, CPU)

    def process(self, frame: RgbdFrame, turn: Turn) -> None:
        self._seen.set_data_from_image("depth", o3d.t.geometry.Image(o3d.core.Tensor(frame.depth)))
        self._seen.set_data_from_image("color", o3d.t.geometry.Image(o3d.core.Tensor(frame.color)))
        if self._count:
            with turn.clock(TRACK):
                found = self._model.track_frame_to_model(
                    self._seen, self._predicted, self._scale, GREATEST_DEPTH_M, GREATEST_STEP_M, self._method
                )
            self._pose = self._pose @ found.transformation.numpy()
        self._model.update_frame_pose(self._count, o3d.core.Tensor(self._pose))
        self._model.integrate(self._seen, self._scale, GREATEST_DEPTH_M, TRUNCATION_VOXELS)
        self._model.synthesize_model_frame(
            self._predicted, self._scale, LEAST_DEPTH_M, GREATEST_DEPTH_M, TRUNCATION_VOXELS, self._has_color
        )
        self._count += 1
        turn.world_from_camera = self._pose.copy()

    def depth(self, frame: RgbdFrame) -> None:  # noqa: ARG002
        return None


class PointToPlane(ModelTracking):
    """Depth alone."""

    def __init__(self, scene: Scene) -> None:
        super().__init__(scene, o3d.t.pipelines.odometry.Method.PointToPlane, has_color=False)


class Hybrid(ModelTracking):
    """Depth and intensity."""

    def __init__(self, scene: Scene) -> None:
        super().__init__(scene, o3d.t.pipelines.odometry.Method.Hybrid, has_color=True)


def _camera_from_world(frame: RgbdFrame) -> NDArray[np.float64]:
    assert frame.world_from_camera is not None
    return np.linalg.inv(frame.world_from_camera)
