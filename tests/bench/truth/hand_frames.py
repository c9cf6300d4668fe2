"""A real moving hand before a real room: hand_depth_sr305's depth put into another depth camera's frames.

The hand pictures have depth alone; the hand gets a skin colour, shaded by its own normals. Both cameras stand in one
place, so that a hand pixel keeps its depth and only its column and row change with the focal length.
"""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from typing import Protocol

import cv2
import numpy as np
from numpy.typing import NDArray

from protocol.frames import CameraModel, RgbdFrame

SEQUENCES = ("20210326-230536", "20210326-231615")
"""An arm that sweeps across the picture, and a hand that opens and closes."""
_HAND_CAMERA = CameraModel(
    width=640, height=480, fx=476.007, fy=476.007, cx=313.683, cy=242.755, depth_scale_m=0.000125
)
_HAND_THICKNESS_M = 0.10
_SKIN = np.array([0.55, 0.33, 0.24])
_TO_LAMP = np.array([-0.40, -0.60, -0.70]) / 1.005
_PICTURE_NOISE_CODES = 2.0
_KINECT_BASELINE_M = 0.075
_FRAY_PX = 3
_SEED = 20150923

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]


class Frames(Protocol):
    """The part of a source that is needed here; see client.sources.frame_source.Source."""

    @property
    def camera(self) -> CameraModel: ...
    def __len__(self) -> int: ...
    def __getitem__(self, index: int) -> RgbdFrame: ...


def hand_pictures(folder: Path) -> list[Path]:
    """The depth pictures in the order in which they were taken."""
    return [
        path for name in SEQUENCES for path in sorted((folder / name).glob("*.png"), key=lambda path: int(path.stem))
    ]


class HandBefore:
    """`room`'s frames with the hand in front, from frame `first` on, each hand picture for `hold` frames, then gone.

    `worn`: the hand is measured as structured light would: its rim is frayed, and the wall beside it lies in the
    projector's shadow. The picture still shows all of it.
    """

    def __init__(self, room: Frames, folder: Path, first: int, *, hold: int = 1, worn: bool = False) -> None:
        self._room = room
        self.camera = room.camera
        self._pictures = hand_pictures(folder)
        self._hold = hold
        self._worn = worn
        self.frames_with_hand = range(first, min(first + hold * len(self._pictures), len(room)))
        self._hand = lru_cache(maxsize=2)(self._read_hand)

    def __len__(self) -> int:
        return len(self._room)

    def hand_m(self, index: int) -> Floats:
        """[h, w] depth of the hand alone, metres, 0 where it is not: the composited mask and its truth."""
        if index not in self.frames_with_hand:
            return np.zeros((self.camera.height, self.camera.width))
        return self._hand((index - self.frames_with_hand.start) // self._hold)

    def __getitem__(self, index: int) -> RgbdFrame:
        frame, hand_m = self._room[index], self.hand_m(index)
        mask, scale = hand_m > 0, self.camera.depth_scale_m
        if not mask.any():
            return frame
        random = np.random.default_rng([_SEED, index])
        depth_m = np.where(mask, hand_m, frame.depth * scale)
        if self._worn:
            depth_m[mask & _frayed(mask, random)] = 0
            depth_m[~mask & _shadowed(hand_m, depth_m, self.camera.fx)] = 0
        color = np.where(mask[..., None], skin_picture(self.camera, hand_m, random), frame.color)
        return replace(frame, color=color, depth=np.rint(depth_m / scale).astype(np.uint16))

    def _read_hand(self, number: int) -> Floats:
        units = cv2.imread(str(self._pictures[number]), cv2.IMREAD_UNCHANGED)
        if units is None:
            raise ValueError(f"{self._pictures[number]}: cannot be read as a picture")
        return reproject(self.camera, nearest_part(units.astype(np.float64) * _HAND_CAMERA.depth_scale_m))


def nearest_part(depth_m: Floats) -> Floats:
    """Of a person's depth [h, w] the hand: the largest piece in front, and not cut off by the picture's lower edge."""
    front = np.percentile(depth_m[depth_m > 0], 1) + _HAND_THICKNESS_M
    near = ((depth_m > 0) & (depth_m < front)).astype(np.uint8)
    count, pieces, boxes, _ = cv2.connectedComponentsWithStats(near, connectivity=4)
    bottom = boxes[:, cv2.CC_STAT_TOP] + boxes[:, cv2.CC_STAT_HEIGHT]
    inside = [piece for piece in range(1, count) if bottom[piece] < len(depth_m)]
    return np.where(pieces == max(inside, key=lambda piece: int(boxes[piece, cv2.CC_STAT_AREA])), depth_m, 0)


def reproject(camera: CameraModel, depth_m: Floats) -> Floats:
    """[h, w] of `camera` from depth of the hand's camera: both stand in one place, nearest pixel."""
    v, u = np.mgrid[: camera.height, : camera.width]
    columns = np.rint((u - camera.cx) * _HAND_CAMERA.fx / camera.fx + _HAND_CAMERA.cx).astype(int)
    rows = np.rint((v - camera.cy) * _HAND_CAMERA.fy / camera.fy + _HAND_CAMERA.cy).astype(int)
    height, width = depth_m.shape
    inside = (columns >= 0) & (columns < width) & (rows >= 0) & (rows < height)
    return np.where(inside, depth_m[rows.clip(0, height - 1), columns.clip(0, width - 1)], 0)


def skin_picture(camera: CameraModel, hand_m: Floats, random: np.random.Generator) -> NDArray[np.uint8]:
    """[h, w, 3] sRGB of the hand under one lamp and as much light from all around; noise as of an indoor camera."""
    weight = cv2.GaussianBlur((hand_m > 0).astype(float), (0, 0), 2)
    depth_m = cv2.GaussianBlur(hand_m, (0, 0), 2) / np.maximum(weight, 1e-6)
    down, right = np.gradient(depth_m)
    z = np.maximum(depth_m, 0.1)
    normals = np.stack([right * camera.fx / z, down * camera.fy / z, -np.ones_like(z)], axis=-1)
    normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
    linear = (0.25 + 0.75 * np.maximum(normals @ _TO_LAMP, 0))[..., None] * _SKIN
    codes = 255 * np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)
    noisy: Floats = np.clip(codes + random.normal(0, _PICTURE_NOISE_CODES, codes.shape), 0, 255)
    return noisy.astype(np.uint8)


def _frayed(mask: Bools, random: np.random.Generator) -> Bools:
    """[h, w] where depth is lost: up to 3 pixels from the rim inwards, more or less along it."""
    inward_px = cv2.distanceTransform(mask.astype(np.uint8), cv2.DIST_L2, 3)
    waves = cv2.GaussianBlur(random.normal(size=mask.shape), (0, 0), 3)
    lost: Bools = inward_px <= _FRAY_PX * np.clip(0.5 + waves / waves.std() / 2, 0, 1)
    return lost


def _shadowed(hand_m: Floats, depth_m: Floats, focal_px: float) -> Bools:
    """[h, w] what the hand hides from a projector to the right of the camera."""
    hidden = np.zeros(hand_m.shape, bool)
    disparity = focal_px * _KINECT_BASELINE_M / np.where(depth_m > 0, depth_m, np.inf)
    reach_px = int(focal_px * _KINECT_BASELINE_M / hand_m[hand_m > 0].min())
    columns = np.arange(hand_m.shape[1])
    hand_disparity = focal_px * _KINECT_BASELINE_M / np.where(hand_m > 0, hand_m, np.inf)
    for shift in range(1, reach_px + 1):
        source = columns + shift
        inside = source < hand_m.shape[1]
        caster = np.where(inside, hand_disparity[:, np.minimum(source, hand_m.shape[1] - 1)], 0)
        hidden |= (caster > 0) & (caster - disparity >= shift)
    return hidden
