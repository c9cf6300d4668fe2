"""Where an object may be seen in a picture."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from protocol.frames import CameraModel, RgbdFrame


def may_be_seen(camera: CameraModel, frame: RgbdFrame, foot: NDArray[np.float64]) -> NDArray[np.bool_]:
    """[height, width] where the vase can be, with a margin."""
    camera_from_world = np.linalg.inv(frame.world_from_camera)

    def pixel(height_m: float, aside_m: float) -> tuple[int, int]:
        x, y, z = camera_from_world[:3, :3] @ (foot + np.array([0.0, height_m, 0.0])) + camera_from_world[:3, 3]
        return round(camera.fx * (x + aside_m) / z + camera.cx), round(camera.fy * y / z + camera.cy)

    mask = np.zeros((camera.height, camera.width), np.uint8)
    corners = [pixel(height, aside) for height, aside in ((-0.08, -0.1), (-0.08, 0.1), (0.32, 0.1), (0.32, -0.1))]
    cv2.fillConvexPoly(mask, np.array(corners), 1)
    return mask == 1
