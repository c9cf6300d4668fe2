"""Raw frames of a camera, and the rectified picture that the device makes of them."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from protocol.frames import CameraModel, RgbdFrame
from server.input.measure import measure as measure_stage
from server.opencl.engine import Engine
from tests.scenes.volumes import vectors

PLAIN = CameraModel(width=97, height=71, fx=80.0, fy=78.0, cx=47.3, cy=36.1)


def random_frame(camera: CameraModel, seed: int) -> RgbdFrame:
    """Codes over the whole range, smooth enough that marks change over areas; depth with every special value."""
    rng = np.random.default_rng(seed)
    size = (camera.height, camera.width)
    top = 255 if camera.color_encoding == "srgb8" else 65535
    coarse = rng.uniform(-0.3, 1.3, (9, 9, 3))
    color = np.clip(cv2.resize(coarse, size[::-1], interpolation=cv2.INTER_CUBIC), 0, 1) * top
    depth = rng.integers(0, 12_000, size)
    depth[rng.random(size) < 0.1] = 0
    depth[rng.random(size) < 0.1] = 65535
    return frame_of(np.rint(color), depth, camera)


def frame_of(color: NDArray[Any], depth: NDArray[Any], camera: CameraModel) -> RgbdFrame:
    code = np.uint8 if camera.color_encoding == "srgb8" else np.uint16
    return RgbdFrame(0, 0.0, color.astype(code), depth.astype(np.uint16), None)


def measured(engine: Engine, camera: CameraModel, frame: RgbdFrame) -> tuple[NDArray[Any], NDArray[Any]]:
    result = measure_stage(engine, camera, frame)
    return vectors(engine.download(result.radiance)), engine.download(result.depth_m)
