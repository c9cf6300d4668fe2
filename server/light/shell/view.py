"""What the camera of a picture has in its frame."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from protocol.frames import CameraModel

Floats = NDArray[np.float64]

LEAST_AHEAD_M = 0.05
"""What is nearer is not in a picture."""


@dataclass(frozen=True)
class View:
    """A pinhole camera in the world."""

    eye: Floats
    """[3] metres."""
    axes: Floats
    """[3, 3] columns: to the right, down and ahead."""
    across: tuple[float, float]
    """Tangents of the frame's left and right edge."""
    down: tuple[float, float]
    """Of its upper and lower edge."""

    @staticmethod
    def of(camera: CameraModel, world_from_camera: Floats) -> View:
        """What `camera` has in its frame, as if its lens did not distort. world_from_camera: [4, 4] rigid."""
        across = -camera.cx / camera.fx, (camera.width - 1 - camera.cx) / camera.fx
        down = -camera.cy / camera.fy, (camera.height - 1 - camera.cy) / camera.fy
        return View(world_from_camera[:3, 3], world_from_camera[:3, :3], across, down)

    def frames(self, points: Floats) -> NDArray[np.bool_]:
        """[n] whether points [n, 3], world, lie in the frame, whatever is in between."""
        x, y, z = ((points - self.eye) @ self.axes).T
        (left, right), (top, bottom) = self.across, self.down
        return np.asarray((z > LEAST_AHEAD_M) & (x >= left * z) & (x <= right * z) & (y >= top * z) & (y <= bottom * z))
