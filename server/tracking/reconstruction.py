"""The reconstruction that cameras of a room share: volume, keyframes, exposure."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from protocol.frames import CameraModel, RgbdFrame
from protocol.messages import Wishes
from server.opencl.engine import Engine
from server.tracking.relocalize import Keyframes
from server.volume.bounds import Bounds, bounds_seen, default_voxel_m
from server.volume.volume import Volume

MARGIN_M = 1.5
"""Margin of a shared volume around the surface that its first camera sees, since other cameras look elsewhere."""


class Reconstruction:
    """Accumulates the fused frames of all cameras."""

    def __init__(self, engine: Engine, *, is_shared: bool = False) -> None:
        self._engine = engine
        self.exposure_logarithms = 0.0
        """Sum over all fused frames."""
        self.is_shared = is_shared
        """Whether several cameras scan this volume."""
        self.volume: Volume | None = None
        self.keyframes = Keyframes()
        """Views of all tracked cameras."""

    def volume_for(
        self, wishes: Wishes, camera: CameraModel, frame: RgbdFrame, world_from_camera: NDArray[np.float64]
    ) -> Volume:
        """The volume; created by the first frame, around what it sees unless the wishes give the bounds.

        Raises ValueError, one line, for a first frame without depth.
        """
        if self.volume is None:
            if not frame.has_depth:
                raise ValueError("nobody has scanned this room yet, and this client has no depth to do so")
            seen = wishes.volume_m or bounds_seen(camera, frame, world_from_camera)
            voxel_m = wishes.voxel_m or default_voxel_m(seen)
            bounds = seen if wishes.volume_m else _widened(seen, MARGIN_M if self.is_shared else 0.0)
            self.volume = Volume(self._engine, bounds, voxel_m)
        return self.volume

    def count_exposure(self, exposure: float) -> None:
        """Add the exposure of a fused frame, relative to the first frame."""
        self.exposure_logarithms += math.log(exposure)

    @property
    def usual_exposure(self) -> float:
        """Geometric mean over all fused frames: with it the volume's colours look as in most pictures."""
        frames = self.volume.frames if self.volume else 0
        return math.exp(self.exposure_logarithms / frames) if frames else 1.0


def _widened(bounds: Bounds, margin_m: float) -> Bounds:
    x0, y0, z0, x1, y1, z1 = bounds
    return x0 - margin_m, y0 - margin_m, z0 - margin_m, x1 + margin_m, y1 + margin_m, z1 + margin_m
