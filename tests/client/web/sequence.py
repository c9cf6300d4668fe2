"""Frames of a known camera as a device of WebXR tells them: column-major, +y up, depth across the picture."""

from __future__ import annotations

import base64
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from protocol.frames import CameraModel, RgbdFrame

FLIP = np.diag([1.0, -1.0, -1.0, 1.0])
"""Between the camera axes of OpenCV and of WebXR."""


@dataclass(frozen=True)
class Turned:
    """How the depth sensor lies in the view."""

    matrix: NDArray[np.float64]
    """[3, 3] homogeneous: from the view, 0 to 1 and y down, to the depth buffer, likewise."""
    turns: int
    """Quarters, counter-clockwise (np.rot90), by which upright depth becomes the buffer's."""


STRAIGHT = Turned(np.eye(3), 0)
ACROSS = Turned(np.array([[0.0, 1.0, 0.0], [-1.0, 0.0, 1.0], [0.0, 0.0, 1.0]]), 1)
"""A sensor of a tablet that is held upright: the view's right is the buffer's up."""


def projection_of(camera: CameraModel) -> NDArray[np.float64]:
    """[4, 4] OpenGL projection of the lens; edges of the picture at -1 and 1."""
    width, height = camera.width, camera.height
    return np.array(
        [
            [2 * camera.fx / width, 0, 1 - 2 * (camera.cx + 0.5) / width, 0],
            [0, 2 * camera.fy / height, 2 * (camera.cy + 0.5) / height - 1, 0],
            [0, 0, -1, -0.2],
            [0, 0, -1, 0],
        ]
    )


def of_device(
    camera: CameraModel, frames: Sequence[RgbdFrame], turned: Turned = STRAIGHT, *, loops: bool = False
) -> dict[str, Any]:
    """What `device.load` (device.js) takes. Depth is that of the frames, whatever its size."""
    norm = np.eye(4)
    norm[:2, :2], norm[:2, 3] = turned.matrix[:2, :2], turned.matrix[:2, 2]
    lying = [np.rot90(frame.depth, turned.turns) for frame in frames]
    height, width = lying[0].shape
    return {
        "width": camera.width,
        "height": camera.height,
        "projection": _column_major(projection_of(camera)),
        "depth_width": width,
        "depth_height": height,
        "depth_scale_m": camera.depth_scale_m,
        "format": "unsigned-short",
        "norm_depth_from_norm_view": _column_major(norm),
        "loops": loops,
        "frames": [
            {
                "matrix": _column_major(frame.world_from_camera @ FLIP),
                "color": _base64(cv2.cvtColor(frame.color, cv2.COLOR_RGB2RGBA)),
                "depth": _base64(depth),
            }
            for frame, depth in zip(frames, lying, strict=True)
        ],
    }


def _column_major(matrix: NDArray[np.float64]) -> list[float]:
    return matrix.T.ravel().tolist()


def _base64(values: NDArray[Any]) -> str:
    return base64.b64encode(np.ascontiguousarray(values).tobytes()).decode()
