"""Results of one frame, as `run` and `stream` write and show them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from client.display.layers import shown_picture
from protocol.frames import CameraModel, RgbdFrame
from protocol.messages import Light, Plan, Timings


@dataclass(frozen=True)
class Captured:
    """What the camera saw in a frame."""

    color: NDArray[np.uint8]
    """[height, width, 3] 8-bit sRGB without lens distortion: pixel for pixel what the composite was made from."""
    depth: NDArray[np.uint16] | None
    """[height, width] of `CameraModel.depth_lens`, in units of `CameraModel.depth_scale_m`, 0 = no measurement; None:
    the camera has no depth sensor."""


@dataclass(frozen=True)
class FrameOutput:
    """Results of one frame."""

    frame: int
    """Position in the source; names the picture."""
    timestamp_s: float
    color: NDArray[np.uint8]
    """[height, width, 3] composite, 8-bit sRGB."""
    light: Light
    world_from_camera: NDArray[np.float64]
    """[4, 4] metres."""
    tracking: str
    """given, tracked or lost."""
    timings: Timings
    plan: Plan
    notes: tuple[str, ...] = ()
    captured: Captured | None = None
    """None: the camera's own picture is not at hand."""


def captured_of(frame: RgbdFrame, camera: CameraModel) -> Captured:
    """What this camera saw in a frame."""
    return Captured(shown_picture(frame.color, camera), frame.depth if frame.has_depth else None)
