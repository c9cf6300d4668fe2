"""A grey floor as a camera sees it, and the place on it where tests stand a virtual pole."""

from __future__ import annotations

import numpy as np

from protocol.frames import CameraModel, RgbdFrame
from tests.scenes.analytic import look, look_at, plane

CAMERA = CameraModel(width=160, height=120, fx=140.0, fy=140.0, cx=79.5, cy=59.5)
BOUNDS = (-0.8, -0.3, 0.5, 0.8, 0.4, 2.1)
POLE_M = (0.0, 0.2, 1.2)
"""Foot of the virtual pole, on the floor; y is down."""
VIEW = look_at((0.4, -0.6, 0.1), POLE_M)
GREY = 150


def frame() -> RgbdFrame:
    seen = look([plane(POLE_M, (0.0, -1.0, 0.0))], CAMERA, VIEW).depth_m
    depth = np.where(seen < 4, np.rint(1000 * seen), 0).astype(np.uint16)
    return RgbdFrame(0, 0.0, np.full((CAMERA.height, CAMERA.width, 3), GREY, np.uint8), depth, VIEW)
