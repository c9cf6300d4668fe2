"""A furnished room whose depth is known in closed form, and walks through it: what memory and order are measured on."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from protocol.frames import CameraModel, RgbdFrame
from server.input.measure import measure
from server.opencl.engine import Engine
from server.volume.integrate import integrate
from server.volume.raycast import raycast
from server.volume.volume import Volume

Floats = NDArray[np.float64]
CAMERA = CameraModel(width=640, height=480, fx=525.0, fy=525.0, cx=319.5, cy=239.5, depth_scale_m=0.0005)


@dataclass(frozen=True)
class Room:
    """Boxes inside a box, world metres, y down."""

    size_m: tuple[float, float, float]
    furniture: tuple[tuple[tuple[float, float, float], tuple[float, float, float]], ...]
    """Corners of each box."""

    def depth_m(self, camera: CameraModel, world_from_camera: Floats) -> Floats:
        """[h, w] along the optical axis, of a camera inside the room and outside its furniture."""
        v, u = np.mgrid[: camera.height, : camera.width]
        rays = np.stack([(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, np.ones(u.shape)], -1)
        rays = rays @ world_from_camera[:3, :3].T
        rays[np.abs(rays) < 1e-12] = 1e-12
        origin = world_from_camera[:3, 3]
        depth: Floats = _span(origin, rays, (0, 0, 0), self.size_m)[1]
        for low, high in self.furniture:
            enter, leave = _span(origin, rays, low, high)
            depth = np.where((enter <= leave) & (enter > 0), np.minimum(depth, enter), depth)
        return depth

    def frame(self, index: int, camera: CameraModel, world_from_camera: Floats) -> RgbdFrame:
        """What a perfect sensor gives, in whole depth units."""
        depth = np.rint(self.depth_m(camera, world_from_camera) / camera.depth_scale_m).astype(np.uint16)
        color = np.full((*depth.shape, 3), 128, np.uint8)
        return RgbdFrame(index, index / 30, color, depth, world_from_camera)


LIVING_ROOM = Room(
    (6.0, 3.0, 6.0),
    (
        ((0.0, 2.1, 0.5), (0.9, 3.0, 2.7)),  # a sofa along a wall
        ((2.2, 2.3, 4.6), (3.8, 3.0, 5.4)),  # a table
        ((5.4, 0.8, 0.0), (6.0, 3.0, 1.8)),  # a cupboard
        ((4.9, 2.5, 3.4), (5.5, 3.0, 4.0)),  # a stool
        ((2.7, 0.0, 2.9), (3.1, 0.5, 3.3)),  # a lamp
    ),
)


def looking(eye: ArrayLike, yaw_rad: float, pitch_rad: float) -> Floats:
    """[4, 4] world_from_camera at `eye`, turned about the vertical, then up."""
    cy, sy, cp, sp = np.cos(yaw_rad), np.sin(yaw_rad), np.cos(pitch_rad), np.sin(pitch_rad)
    pose = np.eye(4)
    pose[:3, :3] = np.array([[cy, 0, sy], [0, 1, 0], [-sy, 0, cy]]) @ np.array([[1, 0, 0], [0, cp, -sp], [0, sp, cp]])
    pose[:3, 3] = eye
    return pose


def walk(frames: int) -> list[Floats]:
    """Poses of somebody who goes round the middle of LIVING_ROOM and turns round three times: level, up and down."""
    poses = []
    for i in range(frames):
        turn = 2 * np.pi * i / frames
        eye = (3 + 1.3 * np.sin(turn), 1.5, 3 - 1.3 * np.cos(turn))
        poses.append(looking(eye, 3 * turn, (0.0, 0.75, -0.75)[3 * i // frames]))
    return poses


def fuse_frame(engine: Engine, volume: Volume, camera: CameraModel, frame: RgbdFrame) -> None:
    """Allocate and integrate one picture that has a pose."""
    assert frame.world_from_camera is not None
    volume_from_camera = volume.volume_from_world() @ frame.world_from_camera
    measurement = measure(engine, camera, frame)
    volume.allocate(camera, volume_from_camera, measurement.depth_m)
    integrate(engine, volume, camera, volume_from_camera, measurement)


def seen_depth(engine: Engine, volume: Volume, camera: CameraModel, world_from_camera: Floats) -> Floats:
    """[h, w] metres along the optical axis to the volume's surface, 0 = none."""
    volume_from_camera = volume.volume_from_world() @ world_from_camera
    volume.bring_back(camera, volume_from_camera)
    positions = engine.download(raycast(engine, camera, volume_from_camera, volume).positions)
    points = positions.view(np.float32).reshape(*positions.shape, 4).astype(np.float64)
    depth: Floats = (points[..., :3] - volume_from_camera[:3, 3]) @ volume_from_camera[:3, 2]
    return np.where(points[..., 3] > 0, depth, 0.0)


def _span(origin: Floats, rays: Floats, low: ArrayLike, high: ArrayLike) -> tuple[Floats, Floats]:
    enter, leave = np.full(rays.shape[:-1], -np.inf), np.full(rays.shape[:-1], np.inf)
    for axis in range(3):  # by column: along rows of 3 NumPy is slow
        a, b = ((np.asarray(corner)[axis] - origin[axis]) / rays[..., axis] for corner in (low, high))
        enter, leave = np.maximum(enter, np.minimum(a, b)), np.minimum(leave, np.maximum(a, b))
    return enter, leave
