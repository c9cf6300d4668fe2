"""Frame contexts for tests of single effects."""

from __future__ import annotations

from typing import Any

import numpy as np

from protocol.frames import CameraModel
from server.frame_context import FrameContext
from server.input.measure import Measurement
from server.opencl.engine import Engine
from server.transfer.radiance_transfer import Directions
from server.transfer.sampling import PRESETS
from server.volume.raycast import Surface


def context_of(
    engine: Engine, camera: CameraModel, surface: Surface, volume: Any, rays: Directions, ray_length_m: float
) -> FrameContext:
    """A frame whose camera stands at the volume's origin, black to look at."""
    black: Any = engine.workspace.array("context_black", (1,), np.float32)
    return FrameContext(
        engine=engine,
        camera=camera,
        volume=volume,
        volume_from_camera=np.eye(4),
        measurement=Measurement(black, black),
        surface=surface,
        scene_radiance=black,
        exposure=1.0,
        sampling=PRESETS["reg4"],
        rays=rays,
        ray_length_m=ray_length_m,
    )
