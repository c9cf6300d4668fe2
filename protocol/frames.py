"""Camera model and RGB-D frame in memory, shared by sources, wire format and pipeline."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Annotated, Literal

import msgspec
import numpy as np
from numpy.typing import NDArray

from protocol.limits import MAX_IMAGE_PIXELS, MAX_IMAGE_SIDE_PX

ColorEncoding = Literal["srgb8", "linear16"]


Distortion = tuple[float, float, float, float, float]
NO_DISTORTION: Distortion = (0.0, 0.0, 0.0, 0.0, 0.0)
IDENTITY = (1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0)
Matrix4 = Annotated[tuple[float, ...], msgspec.Meta(min_length=16, max_length=16)]

GREATEST_BASELINE_M = 2.0
"""Largest distance between the lenses of one camera; a larger one is probably given in millimetres."""
GREATEST_SHIFT_M = 1000.0
"""Largest distance between the world origins of two clients in one room."""
GREATEST_PLACE_M = 10_000.0
"""Greatest coordinate of a camera or an object: beyond it float32 resolves less than a millimetre."""
LEAST_FIELD_OF_VIEW_DEG = 1.0
"""Along a side of the picture."""
GREATEST_ANGLE_DEG = 85.0
"""Greatest angle of a pixel's ray with the optical axis, along a side: a pinhole model describes no wider lens."""
GREATEST_DISTORTION = 100.0
"""Greatest coefficient: those of k3 reach tens where a narrow lens is calibrated."""
DEPTH_SCALE_M = (1e-6, 1.0)
"""Least and greatest unit of depth: micrometres to metres."""
LEAST_PICTURE_SHARE = 0.1
"""Of the rectified picture, that a distortion must leave inside the picture that is sent."""
_NEAR_ROTATION = 1e-3


class DepthCamera(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Lens of the depth image, if it differs from the colour lens; conventions as in `CameraModel`."""

    width: int
    """Pixels."""
    height: int
    """Pixels."""
    fx: float
    """Focal length in pixels: of the width's direction."""
    fy: float
    """Focal length in pixels: of the height's direction."""
    cx: float
    """Principal point, pixels; 0 is the centre of the first column."""
    cy: float
    """Pixels; 0 is the centre of the first row."""
    distortion: Distortion = NO_DISTORTION
    """OpenCV's k1, k2, p1, p2, k3; all zero for a rectified picture."""
    color_from_depth: Matrix4 = IDENTITY
    """Row-major rigid 4x4, metres: point_in_color_camera = color_from_depth * point_in_depth_camera."""

    def __post_init__(self) -> None:
        _check_lens("camera.depth", self)
        check_rigid("camera.depth.color_from_depth", self.color_from_depth, GREATEST_BASELINE_M)


class CameraModel(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Pinhole camera with polynomial distortion, for the colour image, and for the depth image unless `depth` is set.

    A pixel centre lies at integer coordinates: `u = fx * x / z + cx`. Distortion is OpenCV's
    `(k1, k2, p1, p2, k3)` on normalised coordinates, all zero for a rectified camera.
    """

    width: int
    """Pixels."""
    height: int
    """Pixels."""
    fx: float
    """Focal length in pixels: of the width's direction."""
    fy: float
    """Focal length in pixels: of the height's direction."""
    cx: float
    """Principal point, pixels; 0 is the centre of the first column."""
    cy: float
    """Pixels; 0 is the centre of the first row."""
    depth_scale_m: float = 0.001
    """Metres per unit of the uint16 depth."""
    distortion: Distortion = NO_DISTORTION
    """OpenCV's k1, k2, p1, p2, k3; all zero for a rectified picture."""
    color_encoding: ColorEncoding = "srgb8"
    """What the numbers of every colour picture of the session are."""
    depth: DepthCamera | None = None
    """None: depth is registered to colour, pixel by pixel."""

    def __post_init__(self) -> None:
        _check_lens("camera", self)
        if not (math.isfinite(self.depth_scale_m) and self.depth_scale_m > 0):
            raise ValueError(f"camera.depth_scale_m is {self.depth_scale_m}, must be positive and finite")

    @property
    def is_distorted(self) -> bool:
        """True if any distortion coefficient of the colour lens is not zero."""
        return any(self.distortion)

    @property
    def depth_lens(self) -> CameraModel | DepthCamera:
        """Lens of the depth image: size, intrinsics and distortion."""
        return self.depth or self

    @property
    def color_from_depth(self) -> NDArray[np.float64]:
        """[4, 4] rigid, metres: from the axes of the depth lens to those of the colour lens."""
        return np.array(self.depth.color_from_depth if self.depth else IDENTITY, np.float64).reshape(4, 4)


def _check_lens(owner: str, lens: CameraModel | DepthCamera) -> None:
    for name in ("width", "height"):
        if not 8 <= getattr(lens, name) <= MAX_IMAGE_SIDE_PX:
            raise ValueError(f"{owner}.{name} is {getattr(lens, name)}, must be 8 to {MAX_IMAGE_SIDE_PX}")
    if lens.width * lens.height > MAX_IMAGE_PIXELS:
        raise ValueError(f"{owner} has {lens.width}x{lens.height} pixels, more than {MAX_IMAGE_PIXELS} in all")
    for name in ("fx", "fy"):
        value = getattr(lens, name)
        if not (math.isfinite(value) and value > 0):
            raise ValueError(f"{owner}.{name} is {value}, must be positive and finite")
    if not np.isfinite((lens.cx, lens.cy, *lens.distortion)).all():
        raise ValueError(f"{owner}.cx, {owner}.cy and {owner}.distortion must be finite")


def check_physical(camera: CameraModel) -> None:
    """Raises ValueError, one line, for a camera that there cannot be; a stranger's could end the server (float32)."""
    least, most = DEPTH_SCALE_M
    if not least <= camera.depth_scale_m <= most:
        raise ValueError(f"camera.depth_scale_m is {camera.depth_scale_m:g} m, must be {least:g} to {most:g}")
    lenses: dict[str, CameraModel | DepthCamera] = {"camera": camera}
    if camera.depth is not None:
        lenses["camera.depth"] = camera.depth
    for owner, lens in lenses.items():
        for axis, size in (("x", lens.width), ("y", lens.height)):
            _check_axis(owner, axis, size, getattr(lens, f"f{axis}"), getattr(lens, f"c{axis}"))
        for number in lens.distortion:
            if abs(number) > GREATEST_DISTORTION:
                raise ValueError(f"{owner}.distortion has {number:g}, more than {GREATEST_DISTORTION:g}")
        _check_distortion(owner, lens)


def _check_distortion(owner: str, lens: CameraModel | DepthCamera) -> None:
    """Refuse a lens whose rectified pixels lie nearly all outside of the picture that is sent (OpenCV's model)."""
    k1, k2, p1, p2, k3 = lens.distortion
    x, y = np.meshgrid(
        (np.linspace(0, lens.width - 1, 33) - lens.cx) / lens.fx,
        (np.linspace(0, lens.height - 1, 33) - lens.cy) / lens.fy,
    )
    r2 = x * x + y * y
    radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
    u = lens.fx * (x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x)) + lens.cx
    v = lens.fy * (y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y) + lens.cy
    inside = (radial > 0) & (u >= -0.5) & (u <= lens.width - 0.5) & (v >= -0.5) & (v <= lens.height - 0.5)
    if inside.mean() < LEAST_PICTURE_SHARE:
        raise ValueError(
            f"{owner}.distortion leaves {100 * inside.mean():.0f} % of the picture: it is k1, k2, p1, p2, k3 of OpenCV"
        )


def _check_axis(owner: str, axis: str, size: int, focal_px: float, center_px: float) -> None:
    most_px = size / (2 * math.tan(math.radians(LEAST_FIELD_OF_VIEW_DEG / 2)))
    if focal_px > most_px:
        raise ValueError(
            f"{owner}.f{axis} is {focal_px:g}, must be at most {most_px:.4g}: "
            f"{LEAST_FIELD_OF_VIEW_DEG:g} degree for {size} pixels"
        )
    farthest_px = max(abs(center_px), abs(size - 1 - center_px))
    if farthest_px > math.tan(math.radians(GREATEST_ANGLE_DEG)) * focal_px:
        raise ValueError(
            f"{owner}.f{axis} {focal_px:g} and {owner}.c{axis} {center_px:g} see farther than {GREATEST_ANGLE_DEG:g} "
            "degrees from the axis: are they in pixels?"
        )


def check_rigid(owner: str, row_major: tuple[float, ...], greatest_shift_m: float = GREATEST_SHIFT_M) -> None:
    """Raises ValueError if 16 row-major numbers are not a rigid transform in metres."""
    if len(row_major) != 16 or not np.isfinite(row_major).all():
        raise ValueError(f"{owner} must be 16 finite numbers")
    matrix = np.array(row_major, np.float64).reshape(4, 4)
    rotation, offset = matrix[:3, :3], matrix[:3, 3]
    if np.abs(matrix[3] - [0, 0, 0, 1]).max() > 1e-6:
        raise ValueError(f"{owner}'s last row is not 0 0 0 1: is it row-major?")
    is_near = np.abs(rotation).max() < 2 and np.abs(rotation @ rotation.T - np.eye(3)).max() < _NEAR_ROTATION
    if not is_near or np.linalg.det(rotation) < 0:
        raise ValueError(f"{owner}'s upper left 3x3 is not a rotation")
    if np.abs(offset).max() > greatest_shift_m:
        raise ValueError(f"{owner} moves by {np.abs(offset).max():g} m: is it in millimetres?")


@dataclass(frozen=True)
class RgbdFrame:
    """One RGB-D frame."""

    index: int
    """0-based position in the source; output files are numbered by it."""
    timestamp_s: float
    color: NDArray[np.uint8] | NDArray[np.uint16]
    """[height, width, 3] RGB of the camera's size: uint8 sRGB (`srgb8`) or uint16 linear radiance (`linear16`)."""
    depth: NDArray[np.uint16]
    """[height, width] of `CameraModel.depth_lens`, in units of `CameraModel.depth_scale_m`, 0 = no measurement."""
    world_from_camera: NDArray[np.float64] | None
    """[4, 4] rigid, metres, OpenCV camera axes (x right, y down, z forward); None if the source has no pose."""
    exposure: float | None = None
    """Exposure time times gain of the colour image, in any constant unit; None if unknown."""
    has_depth: bool = True
    """False: there is no depth sensor and `depth` is empty; the scanned room is used instead."""


@dataclass(frozen=True)
class Viewpoint:
    """View of a client without a camera."""

    index: int
    timestamp_s: float
    world_from_camera: NDArray[np.float64]
    """[4, 4] as in RgbdFrame."""
