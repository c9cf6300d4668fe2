"""A body fused from three views; inside a sphere of even light it must look like that sphere."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from protocol.frames import CameraModel, RgbdFrame
from server.opencl.engine import Engine
from server.volume.raycast import Surface
from server.volume.volume import Volume
from tests.scenes.analytic import Shape, look, look_at
from tests.scenes.volumes import fuse_frame, merged_surface

CAMERA = CameraModel(width=160, height=120, fx=140.0, fy=140.0, cx=79.5, cy=59.5)
BOUNDS = (-0.8, -0.8, 0.5, 0.8, 0.8, 2.1)
VOXEL_M = 0.008
VIEWS = [look_at((x, -0.1, 0.0), (0, 0, 1.2)) for x in (0.0, 0.2, -0.2)]


def frames(body: Shape, color: NDArray[np.uint8]) -> Iterator[RgbdFrame]:
    for index, view in enumerate(VIEWS):
        depth = np.rint(1000 * look([body], CAMERA, view).depth_m)
        yield RgbdFrame(index, index / 30, color, np.where(depth > 5000, 0, depth).astype(np.uint16), view)


def reconstruct(engine: Engine, body: Shape) -> tuple[Volume, Surface]:
    """The spine up to the merged geometry buffer."""
    volume = Volume(engine, BOUNDS, VOXEL_M)
    grey = np.full((CAMERA.height, CAMERA.width, 3), 188, np.uint8)
    for frame in frames(body, grey):
        pose, measured = fuse_frame(engine, volume, CAMERA, frame)
    return volume, merged_surface(engine, volume, CAMERA, pose, measured)
