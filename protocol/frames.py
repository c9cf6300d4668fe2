"""What a frame is, in memory: the camera model and one RGB-D frame, shared by sources, wire and pipeline."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import msgspec
import numpy as np
from numpy.typing import NDArray

from protocol.limits import MAX_IMAGE_SIDE_PX

ColorEncoding = Literal["srgb8", "linear16"]


class CameraModel(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Pinhole camera with polynomial distortion; colour and depth share it (depth is registered to colour).

    A pixel centre lies at integer coordinates: `u = fx * x / z + cx`. Distortion is OpenCV's
    `(k1, k2, p1, p2, k3)` on normalised coordinates, all zero for a rectified camera.
    """

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    depth_scale_m: float = 0.001
    """Metres per unit of the uint16 depth."""
    distortion: tuple[float, float, float, float, float] = (0.0, 0.0, 0.0, 0.0, 0.0)
    color_encoding: ColorEncoding = "srgb8"

    def __post_init__(self) -> None:
        for name in ("width", "height"):
            if not 8 <= getattr(self, name) <= MAX_IMAGE_SIDE_PX:
                raise ValueError(f"camera.{name} is {getattr(self, name)}, must be 8 to {MAX_IMAGE_SIDE_PX}")
        for name in ("fx", "fy", "depth_scale_m"):
            value = getattr(self, name)
            if not (np.isfinite(value) and value > 0):
                raise ValueError(f"camera.{name} is {value}, must be positive and finite")
        if not np.isfinite((self.cx, self.cy, *self.distortion)).all():
            raise ValueError("camera.cx, camera.cy and camera.distortion must be finite")

    @property
    def is_distorted(self) -> bool:
        """True if any distortion coefficient is not zero."""
        return any(self.distortion)


@dataclass(frozen=True)
class RgbdFrame:
    """One RGB-D frame."""

    index: int
    """0-based position in the source; output files are numbered by it."""
    timestamp_s: float
    color: NDArray[np.uint8] | NDArray[np.uint16]
    """[height, width, 3] RGB: uint8 sRGB (`srgb8`) or uint16 linear radiance (`linear16`)."""
    depth: NDArray[np.uint16]
    """[height, width] in units of `CameraModel.depth_scale_m`, 0 = no measurement."""
    world_from_camera: NDArray[np.float64] | None
    """[4, 4] rigid, metres, OpenCV camera axes (x right, y down, z forward); None where the source has no pose."""
