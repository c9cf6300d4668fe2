"""What a device shows, and a pipeline that keeps what arrives of it."""

from __future__ import annotations

import time
from dataclasses import dataclass, field

import cv2
import numpy as np

from protocol.frames import CameraModel, RgbdFrame
from protocol.messages import Hello, Wishes
from tests.client.web.constants import PATIENCE_MS
from tests.service.fakes import FakePipeline, FakeResult, Lab

CAMERA = CameraModel(width=120, height=160, fx=131.0, fy=133.0, cx=56.25, cy=83.5, depth_scale_m=0.00125)
DEPTH_SIZE = (48, 36)
FRAMES = 5


@dataclass
class Received:
    """What pipelines were given."""

    hellos: list[Hello | None] = field(default_factory=list)
    cameras: list[CameraModel] = field(default_factory=list)
    wishes: list[Wishes] = field(default_factory=list)
    frames: list[RgbdFrame] = field(default_factory=list)
    lab: Lab = field(default_factory=Lab)

    def build(
        self, _device: object, camera: CameraModel, wishes: Wishes, _room: object = None, asked: Hello | None = None
    ) -> FakePipeline:
        self.hellos.append(asked)
        self.cameras.append(camera)
        self.wishes.append(wishes)
        return _Recording(self)

    def wait(self, frames: int) -> list[RgbdFrame]:
        until_s = time.monotonic() + PATIENCE_MS / 1e3
        while len(self.frames) < frames and time.monotonic() < until_s:
            time.sleep(0.02)
        assert len(self.frames) >= frames
        return self.frames


class _Recording(FakePipeline):
    def __init__(self, received: Received) -> None:
        super().__init__(received.lab)
        self._received = received

    def process(self, frame: RgbdFrame, **wanted: bool) -> FakeResult:
        self._received.frames.append(frame)
        return super().process(frame, **wanted)


def frames_seen(count: int = FRAMES) -> list[RgbdFrame]:
    """Smooth colour, different on every side; depth of noise with holes; poses about all axes."""
    v, u = np.mgrid[: CAMERA.height, : CAMERA.width] / CAMERA.height
    frames = []
    for index in range(count):
        random = np.random.default_rng(index)
        color = np.stack([250 * u, 250 * v, 60 + 30 * index + 0 * u], axis=-1).astype(np.uint8)
        depth = random.integers(0, 65536, DEPTH_SIZE, np.uint16) * (random.random(DEPTH_SIZE) > 0.2)
        pose = np.eye(4)
        pose[:3, :3] = cv2.Rodrigues(random.normal(size=3))[0]
        pose[:3, 3] = random.normal(size=3)
        frames.append(RgbdFrame(index, index / 30, color, depth.astype(np.uint16), pose))
    return frames
