"""A camera before a wall."""

from __future__ import annotations

import numpy as np

from protocol.frames import CameraModel, RgbdFrame
from tests.client.web.sequence import FLIP

CAMERA = CameraModel(width=160, height=120, fx=150.0, fy=150.0, cx=79.5, cy=59.5)


DEPTH_M, RADIUS_M = 0.6, 0.08


def plane() -> RgbdFrame:
    """A wall across the view of a camera that stands in the origin, by WebXR's axes."""
    depth = np.full((CAMERA.height, CAMERA.width), round(DEPTH_M * 1000), np.uint16)
    return RgbdFrame(0, 0.0, np.full((*depth.shape, 3), 90, np.uint8), depth, FLIP)
