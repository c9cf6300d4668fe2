"""Shared by the readers of captures whose colour and depth differ in size: phones' and other apps' files.

Colour is reduced to at most LONGEST_SIDE_PX. Depth keeps its own pixels as the picture of a lens of its own
(`CameraModel.depth`), and the pipeline registers it to colour.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from client.errors import SourceError
from protocol.frames import IDENTITY, NO_DISTORTION, CameraModel, DepthCamera, Distortion, RgbdFrame

LONGEST_SIDE_PX = 640
"""Of colour. Depth of phones is 256x192: more colour would be interpolated depth at several times the work."""
DEPTH_SCALE_M = 0.001
LEAST_CONFIDENCE = 1
"""ARKit's `medium`; depth of confidence 0, `low`, is no measurement. Apps store the same three levels."""
GL_FROM_CV = np.diag([1.0, -1.0, -1.0, 1.0])
"""ARKit's and OpenGL's camera axes (+y up, +z backward) from OpenCV's, and the reverse."""

Pose = NDArray[np.float64]
Read = Callable[[int], tuple[NDArray[Any], NDArray[np.uint16]]]


@dataclass(frozen=True)
class Lens:
    """Pinhole intrinsics in pixels; a pixel's centre is at integer coordinates."""

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float

    def resized(self, width: int, height: int) -> Lens:
        """The same lens with another number of pixels over the same picture."""
        if (width, height) == (self.width, self.height):
            return self
        x, y = width / self.width, height / self.height
        cx, cy = (self.cx + 0.5) * x - 0.5, (self.cy + 0.5) * y - 0.5
        return Lens(width, height, self.fx * x, self.fy * y, cx, cy)

    def reduced(self) -> Lens:
        """The lens of the picture that `DecodedSource` makes of one of this lens."""
        part = min(1.0, LONGEST_SIDE_PX / max(self.width, self.height))
        return self.resized(round(self.width * part), round(self.height * part))


@dataclass(frozen=True)
class DecodedSource:
    """A capture of which `read` gives colour and depth of a frame as they are in the file."""

    name: str
    camera: CameraModel
    fps: float
    up: tuple[float, float, float] | None
    times_s: tuple[float, ...]
    poses: tuple[Pose, ...] | None
    """world_from_camera [4, 4] of each frame."""
    read: Read = field(repr=False, compare=False)
    """(colour [h, w, 3] uint8 of any size, depth [h, w] uint16 of `camera.depth_lens`) of a frame."""

    @property
    def has_poses(self) -> bool:
        return self.poses is not None

    def __len__(self) -> int:
        return len(self.times_s)

    def __getitem__(self, index: int) -> RgbdFrame:
        index = range(len(self))[index]
        color, depth = self.read(index)
        size = (self.camera.width, self.camera.height)
        if (color.shape[1], color.shape[0]) != size:
            color = cv2.resize(color, size, interpolation=cv2.INTER_AREA)
        lens = self.camera.depth_lens
        if depth.shape != (lens.height, lens.width):
            raise SourceError(
                f"{self.name}: depth of frame {index} is {depth.shape[1]}x{depth.shape[0]}, "
                f"expected {lens.width}x{lens.height}"
            )
        pose = None if self.poses is None else self.poses[index]
        return RgbdFrame(index, self.times_s[index], color, depth, pose)


def camera_of(
    where: object,
    color: Lens,
    depth: Lens,
    color_from_depth: NDArray[np.float64] | None = None,
    *,
    distortion: Distortion = NO_DISTORTION,
    depth_scale_m: float = DEPTH_SCALE_M,
) -> CameraModel:
    """The camera of a `DecodedSource` with these lenses; `color` as in the file. `distortion`: of both.

    Raises SourceError with `where`.
    """
    small = color.reduced()
    matrix = IDENTITY if color_from_depth is None else tuple(float(x) for x in color_from_depth.ravel())
    try:
        own = None
        if depth != small or matrix != IDENTITY:
            own = DepthCamera(**vars(depth), distortion=distortion, color_from_depth=matrix)
        return CameraModel(**vars(small), depth=own, distortion=distortion, depth_scale_m=depth_scale_m)
    except (TypeError, ValueError) as error:
        raise SourceError(f"{where}: {error}") from error


def millimetres(depth_m: NDArray[np.float32]) -> NDArray[np.uint16]:
    """[h, w] in units of DEPTH_SCALE_M of depth in metres; 0 where it is none, not finite, or beyond 65.534 m."""
    units = np.nan_to_num(depth_m / DEPTH_SCALE_M, nan=0.0, posinf=0.0, neginf=0.0).round()
    units[(units < 0) | (units > 65534)] = 0
    found: NDArray[np.uint16] = units.astype(np.uint16)
    return found


def without_unsure(
    depth: NDArray[np.uint16], confidence: NDArray[np.uint8] | None, where: object, least: int = LEAST_CONFIDENCE
) -> NDArray[np.uint16]:
    """`depth` with 0 where its confidence is less than `least`; None: nothing is known. Raises SourceError."""
    if confidence is None:
        return depth
    if confidence.shape != depth.shape:
        raise SourceError(f"{where}: confidence and depth differ in size, {confidence.shape} and {depth.shape}")
    return np.where(confidence >= least, depth, 0).astype(np.uint16)


def frame_rate(times_s: tuple[float, ...], default: float = 30.0) -> float:
    """Frames a second of timestamps."""
    duration_s = times_s[-1] - times_s[0]
    return (len(times_s) - 1) / duration_s if duration_s > 0 else default
