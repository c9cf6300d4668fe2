"""A server that draws layers slowly, and the frames and pictures of tests with it."""

from __future__ import annotations

import dataclasses
import time
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from protocol.frames import RgbdFrame
from tests.client.web.ball_scene import CAMERA, linear, look
from tests.client.web.constants import PICTURES
from tests.client.web.received import Received
from tests.client.web.red_ball import turned
from tests.service import fakes
from tests.service.fakes import FakeResult

SLOW_S = 0.3
STEP_DEG, REACH_DEG = 0.5, 10.0
WALL_CODE = 150


class Drawing(fakes.FakePipeline):
    """A pipeline that takes its time to draw the ball, exactly."""

    def __init__(self, received: Received, takes_s: float) -> None:
        super().__init__(received.lab)
        self._received, self._takes_s = received, takes_s

    def process(self, frame: RgbdFrame, **_: Any) -> FakeResult:
        self._received.frames.append(frame)
        time.sleep(self._takes_s)
        return dataclasses.replace(super().process(frame), layer=look(frame.world_from_camera).layer())


def frame_at(pose: NDArray[np.float64], index: int, color: NDArray[np.uint8] | None = None) -> RgbdFrame:
    wall = np.full((CAMERA.height, CAMERA.width, 3), WALL_CODE, np.uint8) if color is None else color
    return RgbdFrame(index, index / 30, wall, look(pose).wall_depth, pose)


def turning() -> list[RgbdFrame]:
    angles = np.arange(-REACH_DEG, REACH_DEG + STEP_DEG / 2, STEP_DEG)
    return [frame_at(turned(angle), index) for index, angle in enumerate(angles)]


def keep(name: str, rgb: NDArray[Any]) -> None:
    PICTURES.mkdir(parents=True, exist_ok=True)
    cv2.imwrite(str(PICTURES / f"{name}.png"), cv2.cvtColor(rgb.astype(np.uint8), cv2.COLOR_RGB2BGR))


def colorful() -> NDArray[np.uint8]:
    """[h, w, 3] every channel from dark to bright."""
    v, u = np.mgrid[: CAMERA.height, : CAMERA.width]
    return np.stack([20 + 1.4 * u, 10 + 2 * v, 250 - u - 0.7 * v], axis=-1).astype(np.uint8)


def is_ball(rgb: NDArray[Any]) -> NDArray[np.bool_]:
    """Redder than the wall."""
    return linear(rgb[..., 0]) - linear(rgb[..., 1]) > 0.06


def composite(frame: RgbdFrame) -> NDArray[np.uint8]:
    """[h, w, 3] sRGB: what its camera would see."""
    wall = np.full((CAMERA.height, CAMERA.width, 3), WALL_CODE, np.uint8)
    picture: NDArray[np.uint8] = look(frame.world_from_camera).over(wall).round().astype(np.uint8)
    return picture
