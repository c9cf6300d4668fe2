"""Fusion of posed depth pictures into a point cloud (thesis 4.1.1): a weighted mean in every cell of a grid.

Each point keeps the mean direction to its cameras, which later determines the outside.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from client.errors import SourceError
from client.sources.volume import TRUSTED_DEPTH_M
from protocol.frames import CameraModel, DepthCamera, RgbdFrame
from protocol.images import Color

Floats = NDArray[np.float64]

EDGE_OF_DEPTH = 0.03
"""Relative depth step between neighbours that is an edge; pixels at edges mix two surfaces."""
_COLUMNS = 3 + 3 + 3
_MERGE_EVERY = 8
_CELL_BITS = 21


@dataclass(frozen=True)
class PointCloud:
    """n points, ordered by cell."""

    points: Floats
    """[n, 3] world metres."""
    colors: Floats
    """[n, 3] linear RGB."""
    towards_camera: Floats
    """[n, 3] unit, world: mean direction to the cameras that measured the point."""
    weights: Floats
    """[n] 1 / m^2: sum of inverse variances of the measurements."""
    frames: NDArray[np.int64]
    """[n] number of frames that measured the point."""


def depth_noise_m(depth_m: Floats) -> Floats:
    """Standard deviation of a structured-light sensor along its ray (Nguyen, Izadi and Lovell 2012, eq. 3)."""
    noise: Floats = 0.0012 + 0.0019 * (depth_m - 0.4) ** 2
    return noise


class CloudFusion:
    """Fuses frames one at a time; memory is proportional to the surface."""

    def __init__(self, camera: CameraModel, cell_m: float) -> None:
        """`cell_m`: cell size; each cell gives at most one point."""
        self._camera = camera
        self._cell_m = cell_m
        self._rays = pixel_rays(camera.depth_lens)
        self._origin: Floats | None = None
        self._pending: list[tuple[NDArray[np.int64], Floats, NDArray[np.int64]]] = []
        self.frames = 0

    def add(self, frame: RgbdFrame) -> None:
        """Fuse one frame. Raises SourceError if it has no pose."""
        if frame.world_from_camera is None:
            raise SourceError(f"frame {frame.index} has no pose; a model needs a source with poses")
        self.frames += 1
        depth_m = frame.depth.astype(np.float64) * self._camera.depth_scale_m
        usable = usable_pixels(depth_m)
        if not usable.any():
            return
        pose = frame.world_from_camera @ self._camera.color_from_depth
        in_lens = self._rays[usable] * depth_m[usable][:, None]
        colors, colored = self._colors(frame, usable, in_lens)
        offsets = in_lens[colored] @ pose[:3, :3].T
        points = offsets + pose[:3, 3]
        towards = -offsets / np.linalg.norm(offsets, axis=1, keepdims=True)
        weights = depth_noise_m(in_lens[colored, 2]) ** -2
        values = np.hstack([points, linear_colors(colors[colored], self._camera), towards]) * weights[:, None]
        cells, rows = np.unique(self._keys(points), return_inverse=True)
        sums = _sum_rows(rows, np.column_stack([values, weights]), len(cells))
        self._pending.append((cells, sums, np.ones(len(cells), np.int64)))
        if len(self._pending) > _MERGE_EVERY:
            self._merge()

    def cloud(self) -> PointCloud:
        """The cloud so far; from ten frames on, without points that only one frame measured.

        Raises SourceError if there are no points.
        """
        if not self._pending:
            raise SourceError(f"no depth within {TRUSTED_DEPTH_M:g} m: there is nothing to model")
        self._merge()
        _, sums, frames = self._pending[0]
        kept = frames >= (2 if self.frames >= 10 else 1)
        if not kept.any():
            raise SourceError("no point was measured by two frames: are the poses right?")
        sums, frames = sums[kept], frames[kept]
        means = sums[:, :_COLUMNS] / sums[:, _COLUMNS:]
        lengths = np.linalg.norm(means[:, 6:], axis=1, keepdims=True)
        towards = means[:, 6:] / np.where(lengths > 0, lengths, 1.0)
        return PointCloud(means[:, :3], means[:, 3:6], towards, sums[:, _COLUMNS], frames)

    def _colors(self, frame: RgbdFrame, usable: NDArray[np.bool_], in_lens: Floats) -> tuple[Color, NDArray[np.bool_]]:
        """Colours [n, 3] of points [n, 3] in the space of the depth lens, and [n] whether the colour lens sees them."""
        if self._camera.depth is None:
            return frame.color[usable], np.ones(len(in_lens), np.bool_)
        color_from_depth, lens = self._camera.color_from_depth, self._camera
        rotation, _ = cv2.Rodrigues(color_from_depth[:3, :3])
        offset, distortion = color_from_depth[:3, 3].copy(), np.array(lens.distortion, np.float64)
        places, _ = cv2.projectPoints(in_lens, rotation, offset, _matrix(lens), distortion)
        u, v = np.rint(places.reshape(-1, 2)).T
        is_in_front = (in_lens @ color_from_depth[2, :3] + offset[2]) > 0
        seen = is_in_front & (u >= 0) & (u < lens.width) & (v >= 0) & (v < lens.height)
        u, v = (np.where(seen, pixels, 0).astype(np.intp) for pixels in (u, v))
        return frame.color[v, u], seen

    def _keys(self, points: Floats) -> NDArray[np.int64]:
        """[n] number of the cell of each point."""
        if not len(points):
            return np.empty(0, np.int64)
        if self._origin is None:
            self._origin = points[0].copy()
        half = 1 << (_CELL_BITS - 1)
        cells = np.floor((points - self._origin) / self._cell_m) + half
        if ((cells < 0) | (cells >= 2 * half)).any():
            raise SourceError(f"the cameras are more than {half * self._cell_m:.0f} m apart: give a larger --voxel")
        x, y, z = cells.astype(np.int64).T
        keys: NDArray[np.int64] = (z << 2 * _CELL_BITS) | (y << _CELL_BITS) | x
        return keys

    def _merge(self) -> None:
        keys, rows = np.unique(np.concatenate([part[0] for part in self._pending]), return_inverse=True)
        sums = _sum_rows(rows, np.concatenate([part[1] for part in self._pending]), len(keys))
        frames = np.bincount(rows, np.concatenate([part[2] for part in self._pending]), len(keys)).astype(np.int64)
        self._pending = [(keys, sums, frames)]


def pixel_rays(lens: CameraModel | DepthCamera) -> Floats:
    """[h, w, 3] undistorted ray directions with z = 1 in the space of the lens."""
    v, u = np.mgrid[: lens.height, : lens.width].astype(np.float64)
    pixels = np.stack([u, v], axis=-1).reshape(-1, 1, 2)
    xy = cv2.undistortPoints(pixels, _matrix(lens), np.array(lens.distortion, np.float64)).reshape(*u.shape, 2)
    return np.concatenate([xy, np.ones((*u.shape, 1))], axis=-1)


def _matrix(lens: CameraModel | DepthCamera) -> Floats:
    return np.array([[lens.fx, 0, lens.cx], [0, lens.fy, lens.cy], [0, 0, 1.0]])


def usable_pixels(depth_m: Floats) -> NDArray[np.bool_]:
    """[h, w] pixels with depth up to TRUSTED_DEPTH_M and no depth edge to one of the eight neighbours."""
    valid = (depth_m > 0) & (depth_m <= TRUSTED_DEPTH_M)
    # Pixels without depth are no edge: they must be neither maximum nor minimum of a neighbourhood.
    highest = cv2.dilate(np.where(valid, depth_m, 0.0), np.ones((3, 3)))
    lowest = cv2.erode(np.where(valid, depth_m, 2 * TRUSTED_DEPTH_M), np.ones((3, 3)))
    step = np.maximum(highest - depth_m, depth_m - lowest)
    usable: NDArray[np.bool_] = valid & (step <= EDGE_OF_DEPTH * depth_m)
    return usable


def linear_colors(color: Color, camera: CameraModel) -> Floats:
    """Linear RGB in [0, 1] of pixels [n, 3] in the camera's encoding."""
    if camera.color_encoding == "linear16":
        return color / 65535.0
    srgb = color / 255.0
    return np.where(srgb <= 0.04045, srgb / 12.92, ((srgb + 0.055) / 1.055) ** 2.4)


def _sum_rows(rows: NDArray[np.intp], values: Floats, count: int) -> Floats:
    """[count, k] sums of values [n, k] per row, in the given order."""
    return np.stack([np.bincount(rows, column, count) for column in values.T], axis=1)
