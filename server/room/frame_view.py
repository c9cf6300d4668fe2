"""What one frame shows of its room, on the host: for places that are found in the picture."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from protocol.frames import CameraModel
from server.geometry.geometry import GeometryFrame
from server.maths.rigid import inverse_rigid
from server.opencl.buffers import BufferGroup, StageBuffers
from server.opencl.engine import Engine
from server.volume.raycast import SurfaceBuffers, raycast
from server.volume.volume import Volume

Floats = NDArray[np.float64]

NEAR_PX = 2
"""A pixel without depth takes that of the nearest pixel up to so far away."""
SAME_SURFACE = 0.01
"""Relative difference of depth up to which neighbouring pixels show one surface: 2 cm at 2 m, a Kinect's noise."""
_ACROSS_PX = 320
"""Pixels in a row from which horizontal surfaces are sought."""
_RAY = CameraModel(width=8, height=8, fx=400.0, fy=400.0, cx=0.0, cy=0.0)
"""Pixel (0, 0) of the smallest camera looks along the optical axis."""


class _Buffers(StageBuffers):
    ray = BufferGroup(SurfaceBuffers)


@dataclass(frozen=True)
class FrameView:
    """One frame, in the room's world, metres."""

    index: int
    """The client's number."""
    camera: CameraModel
    room_from_camera: Floats
    """[4, 4] rigid."""
    up: Floats
    """[3] unit."""
    depth_m: NDArray[np.float32]
    """[h, w] the sensor's, along the optical axis; 0 = none."""
    positions: NDArray[np.float32]
    """[h, w, 3] of the hybrid surface."""
    normals: NDArray[np.float32]
    """[h, w, 3] unit."""
    is_surface: NDArray[np.bool_]
    """[h, w] whether position and normal are known."""

    def in_pixel(self, u: float, v: float) -> Floats | None:
        """[3] point of the surface seen in a pixel: at the sensor's depth there, else at that of the scan; None without
        either."""
        depth_m = _depth_near(self.depth_m, u, v) or _depth_near(self._scan_depth_m(), u, v)
        if depth_m is None:
            return None
        camera = self.camera
        in_camera = depth_m * np.array([(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, 1.0])
        return np.asarray(self.room_from_camera[:3, :3] @ in_camera + self.room_from_camera[:3, 3])

    def _scan_depth_m(self) -> Floats:
        axis = self.room_from_camera[:3, 2]
        depth_m = self.positions @ axis - self.room_from_camera[:3, 3] @ axis
        return np.asarray(np.where(self.is_surface, depth_m, 0.0))

    def surface_points(self) -> tuple[Floats, Floats]:
        """[n, 3] positions and [n, 3] normals of every few pixels with surface."""
        step = max(self.camera.width // _ACROSS_PX, 1)
        chosen = self.is_surface[::step, ::step]
        points, normals = (every[::step, ::step][chosen] for every in (self.positions, self.normals))
        return points.astype(np.float64), normals.astype(np.float64)

    def project(self, points: Floats) -> Floats:
        """[..., 3] u, v and depth of points [..., 3] in the rectified picture; NaN behind the camera."""
        camera, camera_from_room = self.camera, inverse_rigid(self.room_from_camera)
        in_camera = points @ camera_from_room[:3, :3].T + camera_from_room[:3, 3]
        z = np.where(in_camera[..., 2] > 1e-6, in_camera[..., 2], np.nan)
        u, v = (
            f * in_camera[..., k] / z + c for k, (f, c) in enumerate([(camera.fx, camera.cx), (camera.fy, camera.cy)])
        )
        return np.stack([u, v, z], axis=-1)


def frame_view(
    engine: Engine, camera: CameraModel, geometry: GeometryFrame, volume: Volume, up: Floats, index: int
) -> FrameView:
    """The view of a frame whose geometry is known. Waits for the device and copies two pictures: 10 ms at 640x480."""
    size = (camera.height, camera.width, 4)
    positions = engine.download(geometry.surface.positions).view(np.float32).reshape(size)
    normals = engine.download(geometry.surface.normals).view(np.float32).reshape(size)
    return FrameView(
        index=index,
        camera=camera,
        room_from_camera=geometry.world_from_camera,
        up=up,
        depth_m=engine.download(geometry.measurement.depth_m),
        positions=positions[..., :3] + volume.origin_world.astype(np.float32),
        normals=normals[..., :3],
        is_surface=(positions[..., 3] > 0) & (normals[..., 3] > 0),
    )


def surface_on_ray(engine: Engine, volume: Volume, origin: Floats, direction: Floats) -> Floats | None:
    """[3] world: where a ray first meets the scanned surface; None if it does not, within a depth camera's range.

    Surface out of view that was released to the host is not met: bringing it back could release what is in view.
    """
    forward = direction / np.linalg.norm(direction)
    across = np.cross(forward, np.eye(3)[int(np.argmin(np.abs(forward)))])
    across /= np.linalg.norm(across)
    pose = np.eye(4)
    pose[:3, :3] = np.stack([across, np.cross(forward, across), forward], axis=1)
    pose[:3, 3] = origin
    volume_from_camera = volume.volume_from_world() @ pose
    surface = raycast(engine, _RAY, volume_from_camera, volume, engine.buffers(_Buffers).ray)
    x, y, z, is_hit = engine.download(surface.positions)[0, 0].item()
    return np.array([x, y, z]) + volume.origin_world if is_hit else None


def _depth_near(depth_m: NDArray[np.floating[Any]], u: float, v: float) -> float | None:
    """Depth in a pixel of a picture [h, w], the median of what its neighbours measure of the same surface; None if
    there is none, 0, around it."""
    height, width = depth_m.shape
    row, column = round(v), round(u)
    if not (0 <= row < height and 0 <= column < width):
        return None
    around = slice(max(row - NEAR_PX, 0), row + NEAR_PX + 1), slice(max(column - NEAR_PX, 0), column + NEAR_PX + 1)
    places = np.argwhere(depth_m[around] > 0) + np.array([part.start for part in around])
    if not len(places):
        return None
    row, column = places[np.argmin(((places - (v, u)) ** 2).sum(axis=1))]
    nearest = depth_m[row, column]
    block = depth_m[max(row - 1, 0) : row + 2, max(column - 1, 0) : column + 2]
    return float(np.median(block[np.abs(block - nearest) < SAME_SURFACE * nearest]))
