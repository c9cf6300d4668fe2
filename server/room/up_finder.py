"""Finds what is up in a room whose source does not say it, from the normals of the first frames' surface.

- The first frame with surface gives a direction; up to `FRAMES` such frames, of all cameras, refine it. Then it stays.
  Objects that were placed meanwhile turn with it, about the points they were placed at.
- Where they show neither horizontal surface nor two walls, the first camera's own up stays, and a note says so. After
  `FRAMES` such frames every `PAUSE`-th one is searched alone, until one shows it, from which it is found as above.
- The direction belongs to the room: a client that enters later gets it as it is. A saved room keeps the one it had.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from server.maths.up_direction import NormalHistogram, UpFit, find_up
from server.opencl.engine import Engine
from server.volume.raycast import Surface

Floats = NDArray[np.float64]

FRAMES = 10
"""Frames from which up is found: a Kinect's noise of 0.6 degrees in one frame is then below the scan's own bends."""
PAUSE = 20
"""Without a direction after FRAMES, one frame of so many is searched: less than 1 ms a frame in the mean."""
PATCHES_ACROSS = 80
"""Patches in a row of the picture whose normals are averaged: 8 pixels of 640, 4 cm at 3 m. The normals of single
pixels deviate by 10 degrees there in one frame of a Kinect."""
LEAST_COVERED, LEAST_FLAT = 0.75, 0.8
"""Least share of a patch with surface, and least length of its mean normal: 0.8 is a deviation of 37 degrees."""
TOLD_DEG = 1.0
"""Change of the direction that is told again."""


class UpFinder:
    """The up direction of one room. The caller holds the room's lock."""

    def __init__(self, given: Floats | None = None) -> None:
        """given: [3] unit, world; None: to be found."""
        self._up = given
        self._is_settled = given is not None
        self._normals = NormalHistogram()
        self._camera_ups = np.zeros(3)
        self._frames = 0
        """In `_normals`."""
        self._skipped = 0
        """Frames still to be left out."""
        self._has_failed = False
        """Whether FRAMES showed nothing."""
        self._told: Floats | None = None

    @property
    def up(self) -> Floats:
        """[3] unit, world; only after a frame."""
        assert self._up is not None
        return self._up

    def look(self, engine: Engine, surface: Surface | None, world_from_camera: Floats) -> tuple[str, ...]:
        """Learn from one frame; returns notes. surface: None where the frame shows no new one."""
        if self._up is None:
            self._up = -world_from_camera[:3, 1] / np.linalg.norm(world_from_camera[:3, 1])
        if self._is_settled or surface is None:
            return ()
        if self._skipped:
            self._skipped -= 1
            return ()
        self._frames += 1
        self._camera_ups -= world_from_camera[:3, 1]
        self._normals.add(patch_normals(engine.download(surface.normals)))
        camera_up = self._camera_ups / np.linalg.norm(self._camera_ups)
        fit = find_up(self._normals, camera_up)
        if fit is not None:
            self._up, self._is_settled = fit.up, self._frames >= FRAMES
        elif self._has_failed or self._frames >= FRAMES:
            self._begin_again()
        return self._notes(fit, camera_up)

    def _begin_again(self) -> None:
        self._normals, self._camera_ups, self._frames = NormalHistogram(), np.zeros(3), 0
        self._has_failed, self._skipped = True, PAUSE - 1

    def _notes(self, fit: UpFit | None, camera_up: Floats) -> tuple[str, ...]:
        if self._told is not None and _angle_deg(self._told, self.up) < TOLD_DEG:
            return ()
        self._told = self.up
        direction = ",".join(f"{value:.3f}" for value in self.up)
        if fit is None:
            return (
                f"neither floor, table nor two walls show what is up: it is taken from the first camera, {direction}; "
                "give --up x,y,z if objects lean",
            )
        return (
            f"up is {direction}, found from the scan, {_angle_deg(fit.up, camera_up):.0f} degrees from the camera's; "
            "give --up x,y,z if that is wrong",
        )


def patch_normals(normals: NDArray[np.generic], across: int = PATCHES_ACROSS) -> Floats:
    """[n, 3] unit mean normals of the flat patches of a picture; normals: [h, w] float4 as in Surface."""
    height, width = normals.shape
    size = max(round(width / across), 1)
    rows, columns = height // size, width // size
    values = normals.view(np.float32).reshape(height, width, 4)[: rows * size, : columns * size]
    means = cv2.resize(values, (columns, rows), interpolation=cv2.INTER_AREA).reshape(-1, 4).astype(np.float64)
    covered = means[:, 3]
    lengths = np.linalg.norm(means[:, :3], axis=1)
    is_flat = (covered >= LEAST_COVERED) & (lengths >= LEAST_FLAT * covered)
    return np.asarray(means[is_flat, :3] / lengths[is_flat, None])


def _angle_deg(a: Floats, b: Floats) -> float:
    return float(np.degrees(np.arccos(np.clip(a @ b, -1, 1))))
