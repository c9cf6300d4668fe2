"""Rods two or three pixels wide, still and moving, with exact truth: what of them a depth picture keeps."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from protocol.frames import CameraModel, RgbdFrame
from server.opencl.device import Device
from server.volume.bounds import Bounds
from tests.bench.geometry.hybrid import follow
from tests.bench.truth.rooms import CAMERA, Room

Floats = NDArray[np.float64]
Sensor = Callable[[Floats, int], Floats]
"""(exact depth [h, w] in metres, frame) -> measured depth, 0 = none."""

SIZE_M = (3.0, 2.4, 3.0)
VOLUME_M: Bounds = (-0.1, -0.1, -0.1, 3.1, 2.5, 3.1)
ROD_Z_M = 1.5
EYE_M = (1.5, 1.2, 0.3)
_ROD_X_M = (0.9, 1.3, 1.7, 2.1)
_SURELY_M = 0.1
"""The wall is 1.5 m behind the rods: a depth this near to a rod's means the rod."""
_WALL_CODE, _ROD_CODE = 110, 190
_PICTURE_NOISE_CODES = 2.0
_SEED = 20150923


def thickness_m(width_px: float, camera: CameraModel = CAMERA) -> float:
    """Side of a rod that is `width_px` wide in the picture."""
    return width_px * (ROD_Z_M - EYE_M[2]) / camera.fx


@dataclass(frozen=True)
class RodsBefore:
    """Square rods from floor to ceiling before a wall, followed by a camera that sways and leans; see hand.Frames."""

    side_m: float
    camera: CameraModel = CAMERA
    speed_m: float = 0.0
    """To the side, a frame."""
    same_color: bool = False
    """Whether the rods are as bright as the wall, so that the picture does not tell them apart."""
    sensor: Sensor | None = None
    """An exact one where none is given."""
    frames: int = 60

    def __len__(self) -> int:
        return self.frames

    def __getitem__(self, index: int) -> RgbdFrame:
        exact, scale = self.depth_m(index), self.camera.depth_scale_m
        measured = exact if self.sensor is None else self.sensor(exact, index)
        rod_code = _WALL_CODE if self.same_color else _ROD_CODE
        codes = np.where(self.on_rods(index), rod_code, _WALL_CODE)[..., None]
        noise = np.random.default_rng([_SEED, index]).normal(0, _PICTURE_NOISE_CODES, (*codes.shape[:2], 3))
        color = np.rint(codes + noise).clip(0, 255).astype(np.uint8)
        return RgbdFrame(index, index / 30, color, np.rint(measured / scale).astype(np.uint16), self.pose(index))

    def pose(self, index: int) -> Floats:
        """[4, 4] world_from_camera: at most 6 cm from EYE_M, leaning by up to 0.2 rad, so that the rods slant."""
        lean, pose = 0.2 * np.sin(0.11 * index), np.eye(4)
        pose[:2, :2] = [[np.cos(lean), -np.sin(lean)], [np.sin(lean), np.cos(lean)]]
        pose[:3, 3] = EYE_M + 0.06 * np.array([np.sin(0.13 * index), np.sin(0.07 * index), 0])
        return pose

    def depth_m(self, index: int) -> Floats:
        """[h, w] exact."""
        half = self.side_m / 2
        rods = tuple(
            ((x - half, 0.0, ROD_Z_M), (x + half, SIZE_M[1], ROD_Z_M + self.side_m))
            for x in (at + self.speed_m * index for at in _ROD_X_M)
        )
        return Room(SIZE_M, rods).depth_m(self.camera, self.pose(index))

    def on_rods(self, index: int) -> NDArray[np.bool_]:
        """[h, w] where a rod is seen."""
        bare = Room(SIZE_M, ()).depth_m(self.camera, self.pose(index))
        seen: NDArray[np.bool_] = self.depth_m(index) < bare - 1e-6
        return seen


@dataclass
class RodReport:
    """Shares of the rods' pixels, one a frame, under the names of hybrid.Views: sensor, plain, hybrid."""

    kept: dict[str, list[float]] = field(default_factory=lambda: defaultdict(list))
    """At the rod's depth, not the wall's."""
    added: dict[str, list[float]] = field(default_factory=lambda: defaultdict(list))
    """Beside the rods, and nearer than what is there: what they are too thick by."""


def measure_rods(device: Device, source: RodsBefore, voxel_m: float, first: int) -> RodReport:
    """Follow `source`; figures from frame `first` on."""
    report = RodReport()
    for index, views in enumerate(follow(device, source, VOLUME_M, voxel_m, range(len(source)))):
        if index < first:
            continue
        exact, rods = source.depth_m(index), source.on_rods(index)
        for name in ("sensor", "plain", "hybrid"):
            seen = getattr(views, name)
            kept = (seen > 0) & (np.abs(seen - exact) < _SURELY_M) & rods
            added = (seen > 0) & (exact - seen > _SURELY_M) & ~rods
            report.kept[name].append(float(kept.sum() / rods.sum()))
            report.added[name].append(float(added.sum() / rods.sum()))
    return report
