"""A frame for a client without a camera: the scanned surface as a camera at its viewpoint would see it."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from protocol.frames import CameraModel, RgbdFrame, Viewpoint
from server.maths.rigid import repaired_pose
from server.opencl.buffers import BufferGroup, StageBuffers
from server.opencl.engine import Engine
from server.shading.composite import srgb_codes
from server.volume.raycast import SurfaceBuffers, raycast
from server.volume.view_colors import view_colors
from server.volume.volume import Volume


class _Buffers(StageBuffers):
    surface = BufferGroup(SurfaceBuffers)


def imagined_frame(
    engine: Engine, camera: CameraModel, volume: Volume | None, view: Viewpoint, room_from_client: NDArray[np.float64]
) -> RgbdFrame:
    """The frame, without depth. room_from_client: [4, 4] rigid. Raises ValueError, one line, in an empty room."""
    if volume is None:
        raise ValueError("nobody has scanned this room yet: there is nothing to look at")
    pose = repaired_pose(view.world_from_camera)
    volume_from_camera = volume.volume_from_world() @ room_from_client @ pose
    volume.bring_back(camera, volume_from_camera)
    surface = raycast(engine, camera, volume_from_camera, volume, engine.buffers(_Buffers).surface)
    shown = engine.download(view_colors(engine, camera, surface, volume))
    linear = np.stack([shown[channel] for channel in "xyz"], axis=-1).astype(np.float64)
    is_linear = camera.color_encoding == "linear16"
    color = np.rint(65535 * linear.clip(0, 1)).astype(np.uint16) if is_linear else srgb_codes(linear)
    depth = np.zeros((camera.depth_lens.height, camera.depth_lens.width), np.uint16)
    return RgbdFrame(view.index, view.timestamp_s, color, depth, pose, has_depth=False)
