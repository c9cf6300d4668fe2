"""A red ball on the synthetic table before a camera that a hand turns to and fro: where it is seen is known exactly."""

from __future__ import annotations

import cv2
import numpy as np
import trimesh
from numpy.typing import NDArray

from client.synthetic.source import SyntheticSource
from client.synthetic.spec import parse_spec
from protocol.frames import CameraModel, RgbdFrame
from tests.client.web.ball_scene import linear

RADIUS_M = 0.06
PIVOT_M = 0.15
"""How far behind the camera the hand is about which it turns."""
DEGREES_PER_S = 30.0
SUBPIXELS = 4


def turned(angle_deg: float) -> NDArray[np.float64]:
    """Camera from camera: turned to the right by a hand behind it."""
    pose = np.eye(4)
    pose[:3, :3] = cv2.Rodrigues(np.array([0.0, np.deg2rad(angle_deg), 0.0]))[0]
    pose[:3, 3] = pose[:3, :3] @ np.array([0.0, 0.0, PIVOT_M]) - [0.0, 0.0, PIVOT_M]
    return pose


class TurningTable(SyntheticSource):
    """The table of `synthetic:table`, the camera at one place of its path, turning from one side to the other."""

    def __init__(self, size: tuple[int, int], reach_deg: float, step_deg: float) -> None:
        self._angles_deg = np.arange(-reach_deg, reach_deg + step_deg / 2, step_deg)
        width, height = size
        super().__init__(parse_spec(f"synthetic:table?light=7&size={width}x{height}&frames={len(self._angles_deg)}"))
        self.steps_per_s = DEGREES_PER_S / step_deg

    def pose(self, index: int) -> NDArray[np.float64]:
        """world_from_camera [4, 4]."""
        return super().pose(0) @ turned(self._angles_deg[index])


def red_ball() -> bytes:
    """GLB."""
    ball = trimesh.creation.icosphere(subdivisions=4, radius=RADIUS_M)
    ball.visual.vertex_colors = [220, 30, 20, 255]
    _ = ball.vertex_normals  # exported with it
    data: bytes = trimesh.Scene(ball).export(file_type="glb")
    return data


def silhouette(camera: CameraModel, frame: RgbdFrame, foot_m: tuple[float, float, float]) -> NDArray[np.bool_]:
    """[h, w] which pixels show the ball that stands there, by more than a half; what is real hides it."""
    camera_from_world = np.linalg.inv(frame.world_from_camera)
    middle = camera_from_world[:3, :3] @ np.add(foot_m, [0.0, RADIUS_M, 0.0]) + camera_from_world[:3, 3]
    inside = (np.arange(SUBPIXELS) + 0.5) / SUBPIXELS - 0.5
    u = (np.arange(camera.width)[:, None] + inside).ravel()
    v = (np.arange(camera.height)[:, None] + inside).ravel()
    x, y = np.meshgrid((u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy)
    along, length = middle[0] * x + middle[1] * y + middle[2], x * x + y * y + 1
    root = along * along - length * (middle @ middle - RADIUS_M**2)
    shape = (camera.height, SUBPIXELS, camera.width, SUBPIXELS)
    share = (root > 0).reshape(shape).mean(axis=(1, 3))
    nearest_m = ((along - np.sqrt(np.maximum(root, 0))) / length).reshape(shape).mean(axis=(1, 3))
    real_m = frame.depth * camera.depth_scale_m
    return (share > 0.5) & ((real_m == 0) | (nearest_m < real_m + 0.005))


def is_red(rgb: NDArray[np.uint8]) -> NDArray[np.bool_]:
    """[h, w] as nothing else on the table is."""
    red = linear(rgb[..., 0])
    return (red > 2.5 * linear(rgb[..., 1])) & (red > 0.01)
