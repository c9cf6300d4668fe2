"""Default volume and voxel size for a source.

They are functions of the source's frames only, so every command chooses the same volume for the same source.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from client.errors import SourceError
from client.sources.frame_source import Source, is_live
from protocol.frames import CameraModel, RgbdFrame

Volume = tuple[float, float, float, float, float, float]

FRAMES_LOOKED_AT = 12
PIXEL_STEP = 4
TRUSTED_DEPTH_M = 5.0
"""Beyond this, errors of structured light and stereo are several centimetres."""
PERCENTILES = (1, 99)
MARGIN_M = 0.15
SMALLEST_SIDE_M = 0.5

VOXELS_PER_SIDE = 256
FINEST_VOXEL_M = 0.004
VOXEL_STEP_M = 0.0005


def default_volume(source: Source, frames: range) -> Volume:
    """x0, y0, z0, x1, y1, z1 in world metres: bounding box of the surfaces in `frames`. Raises SourceError.

    Uses up to 12 frames spread over the range, but only the first frame of a live source or one without poses.
    """
    chosen = _spread(frames) if source.has_poses and not is_live(source) else [frames[0]]
    points = np.concatenate([_points_in_world(source[i], source.camera) for i in chosen])
    if not len(points):
        raise SourceError(f"{source.name}: no depth within {TRUSTED_DEPTH_M:g} m; give --volume")
    low, high = np.percentile(points, PERCENTILES, axis=0)
    centre, half = (low + high) / 2, np.maximum((high - low) / 2 + MARGIN_M, SMALLEST_SIDE_M / 2)
    # Whole millimetres, which print exactly.
    x0, y0, z0, x1, y1, z1 = (round(float(x), 3) for x in (*(centre - half), *(centre + half)))
    return x0, y0, z0, x1, y1, z1


def enlarged_volume(volume: Volume) -> Volume:
    """`volume` enlarged on all sides by half its longest side, for cameras with an unknown path.

    This needs little memory, as bricks are allocated only near surfaces.
    """
    more = round(max(volume[axis + 3] - volume[axis] for axis in range(3)) / 2, 3)
    x0, y0, z0, x1, y1, z1 = volume
    grown = (x0 - more, y0 - more, z0 - more, x1 + more, y1 + more, z1 + more)
    x0, y0, z0, x1, y1, z1 = (round(value, 3) for value in grown)
    return x0, y0, z0, x1, y1, z1


def default_voxel(volume: Volume) -> float:
    """Voxel size in metres: longest side / 256, rounded up to half millimetres, at least 4 mm."""
    longest_m = max(volume[axis + 3] - volume[axis] for axis in range(3))
    steps = math.ceil(round(longest_m / VOXELS_PER_SIDE / VOXEL_STEP_M, 6))
    return max(FINEST_VOXEL_M, round(steps * VOXEL_STEP_M, 4))


def _spread(frames: range) -> list[int]:
    count = min(FRAMES_LOOKED_AT, len(frames))
    return sorted({frames[int(i)] for i in np.linspace(0, len(frames) - 1, count).round()})


def _points_in_world(frame: RgbdFrame, camera: CameraModel) -> NDArray[np.float64]:
    """[n, 3] metres. Lens distortion is ignored; its effect is smaller than the margin."""
    depth = frame.depth[::PIXEL_STEP, ::PIXEL_STEP] * camera.depth_scale_m
    v, u = np.nonzero((depth > 0) & (depth <= TRUSTED_DEPTH_M))
    z = depth[v, u]
    lens = camera.depth_lens
    x = (u * PIXEL_STEP - lens.cx) / lens.fx * z
    y = (v * PIXEL_STEP - lens.cy) / lens.fy * z
    points = np.stack([x, y, z], axis=1)
    pose = np.eye(4) if frame.world_from_camera is None else frame.world_from_camera
    world_from_depth = pose @ camera.color_from_depth
    return points @ world_from_depth[:3, :3].T + world_from_depth[:3, 3]
