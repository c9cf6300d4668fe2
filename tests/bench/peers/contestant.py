"""What every contestant of the benchmark does with a frame, and how its time is taken."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from protocol.frames import CameraModel, RgbdFrame

INTEGRATE, RAYCAST, TRACK, FILTER = "integrate", "ray cast", "track", "filter before tracking"
ACTIONS = (INTEGRATE, RAYCAST, TRACK, FILTER)
TRUNCATION_VOXELS = 4.0
"""Everyone's truncation: what this program uses."""
LEAST_DEPTH_M, GREATEST_DEPTH_M = 0.1, 4.0


@dataclass(frozen=True)
class Scene:
    """What a contestant is told before the first frame."""

    camera: CameraModel
    bounds_m: tuple[float, float, float, float, float, float]
    """World box x0, y0, z0, x1, y1, z1; a cube for those that know only cubes."""
    voxel_m: float
    start: NDArray[np.float64]
    """world_from_camera [4, 4] of the first frame, for those that track."""

    @property
    def matrix(self) -> NDArray[np.float64]:
        """[3, 3] pinhole matrix."""
        camera = self.camera
        return np.array([[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1]])

    @property
    def voxels_per_side(self) -> int:
        """Voxels along the cube's side."""
        return round((self.bounds_m[3] - self.bounds_m[0]) / self.voxel_m)


@dataclass
class Turn:
    """One frame's times, and the pose where the contestant tracks."""

    wall_ms: dict[str, float] = field(default_factory=dict)
    cpu_ms: dict[str, float] = field(default_factory=dict)
    """Of all threads, waiting in a busy loop included."""
    world_from_camera: NDArray[np.float64] | None = None

    @contextmanager
    def clock(self, action: str) -> Iterator[None]:
        """Add what happens inside to `action`; it must have ended when the block does."""
        yield from self._count(action, 1e3)

    @contextmanager
    def without(self, action: str) -> Iterator[None]:
        """Leave what happens inside out of `action`, whose clock runs around it."""
        yield from self._count(action, -1e3)

    def _count(self, action: str, factor: float) -> Iterator[None]:
        wall, cpu = time.perf_counter(), time.process_time()
        try:
            yield
        finally:
            self.wall_ms[action] = self.wall_ms.get(action, 0.0) + factor * (time.perf_counter() - wall)
            self.cpu_ms[action] = self.cpu_ms.get(action, 0.0) + factor * (time.process_time() - cpu)


class Contestant(Protocol):
    """One way to fuse, to predict or to track. Made in its own process with `Contestant(scene)`."""

    def process(self, frame: RgbdFrame, turn: Turn) -> None:
        """Fold one frame in as its kind does (one that tracks does not look at the pose), timing each action."""

    def depth(self, frame: RgbdFrame) -> NDArray[np.float32] | None:
        """The surface's depth [h, w] metres, 0 = none, as seen from `frame`'s pose; None for one without surface."""
