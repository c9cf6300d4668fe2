"""Small captures in the formats of phones' apps, data sets and ROS, written from one synthetic scene.

Files are made with the real library of a format where there is one: imagecodecs (LZFSE), rosbags, OpenCV (video).
"""

from __future__ import annotations

import csv
import json
import struct
import zipfile
import zlib
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from client.synthetic.source import SyntheticSource, open_synthetic
from protocol.frames import CameraModel, RgbdFrame

SCENE = "synthetic:table?size=128x96&frames=8"
GL = np.diag([1.0, -1.0, -1.0, 1.0])
UNSURE = (slice(40, 47), slice(20, 40))
"""Pixels of depth whose confidence is low."""
START_S = 50.0


class Scene:
    """Frames of the truth; their depth is of half the picture's size where a format has a smaller one."""

    def __init__(self, count: int = 3) -> None:
        self.source: SyntheticSource = open_synthetic(SCENE)
        self.frames: list[RgbdFrame] = [self.source[i] for i in range(count)]
        self.camera: CameraModel = self.source.camera
        self.times_s = [START_S + frame.timestamp_s for frame in self.frames]

    def pose(self, i: int) -> NDArray[np.float64]:
        """world_from_camera."""
        pose = self.frames[i].world_from_camera
        assert pose is not None
        return pose

    def small_depth(self, i: int) -> NDArray[np.uint16]:
        """Every second measurement: the middle of pixel (u, v) is that of (2 u + 1/2, 2 v + 1/2) of the picture."""
        return self.frames[i].depth[::2, ::2]

    def confidence(self, depth: NDArray[Any]) -> NDArray[np.uint8]:
        """2, but 0 at UNSURE and 1 beside it."""
        found = np.full(depth.shape, 2, np.uint8)
        found[UNSURE] = 0
        found[36:40] = 1
        return found


def png(path: Path, picture: NDArray[Any]) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    assert cv2.imwrite(str(path), picture[..., ::-1] if picture.ndim == 3 else picture)


def jpeg(color: NDArray[np.uint8]) -> bytes:
    done, data = cv2.imencode(".jpg", color[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 98])
    assert done
    return data.tobytes()


def quaternion(pose: NDArray[np.float64]) -> list[float]:
    """x, y, z, w by SciPy."""
    return [float(x) for x in Rotation.from_matrix(pose[:3, :3]).as_quat()]


def plain(folder: Path, scene: Scene, **fields: object) -> Path:
    lines = []
    for i, frame in enumerate(scene.frames):
        png(folder / "color" / f"{i:06d}.png", frame.color)
        png(folder / "depth" / f"{i:06d}.png", scene.small_depth(i))
        png(folder / "confidence" / f"{i:06d}.png", scene.confidence(scene.small_depth(i)))
        pose = scene.pose(i) @ (GL if fields.get("camera_axes") == "opengl" else np.eye(4))
        lines.append(" ".join(map(repr, [scene.times_s[i], *map(float, pose[:3, 3]), *quaternion(pose)])))
    (folder / "poses.txt").write_text("\n".join(lines))
    camera = scene.camera
    values = {name: getattr(camera, name) for name in ("width", "height", "fx", "fy", "cx", "cy")}
    (folder / "intrinsics.json").write_text(json.dumps(values | {"up": [0, 1, 0]} | fields))
    return folder


def stray(folder: Path, scene: Scene) -> Path:
    """As the app writes it: its rotation is ARKit's camera turned by 180 degrees about x."""
    camera, rows = scene.camera, []
    folder.mkdir(parents=True, exist_ok=True)
    size = (camera.width, camera.height)
    video = cv2.VideoWriter(str(folder / "rgb.mp4"), cv2.VideoWriter_fourcc(*"mp4v"), 30, size)
    turn = Rotation.from_quat([1, 0, 0, 0])
    for i, frame in enumerate(scene.frames):
        video.write(np.ascontiguousarray(frame.color[..., ::-1]))
        png(folder / "depth" / f"{i:06d}.png", scene.small_depth(i))
        png(folder / "confidence" / f"{i:06d}.png", scene.confidence(scene.small_depth(i)))
        arkit = scene.pose(i) @ GL
        written = (Rotation.from_matrix(arkit[:3, :3]) * turn).as_quat()
        rows.append([scene.times_s[i], f"{i:06d}", *arkit[:3, 3], *written])
    video.release()
    with (folder / "odometry.csv").open("w", newline="") as file:
        file.write("timestamp, frame, x, y, z, qx, qy, qz, qw\n")
        csv.writer(file).writerows(rows)
    matrix = [[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1]]
    np.savetxt(folder / "camera_matrix.csv", matrix, delimiter=",")
    return folder


def arkit_scenes(folder: Path, scene: Scene) -> Path:
    """Poses at half of the frames, and one before and after."""
    camera, lines = scene.camera, []
    for i, frame in enumerate(scene.frames):
        name = f"41048190_{scene.times_s[i]:.3f}"
        png(folder / "lowres_wide" / f"{name}.png", frame.color)
        png(folder / "lowres_depth" / f"{name}.png", frame.depth)
        png(folder / "confidence" / f"{name}.png", scene.confidence(frame.depth))
        (folder / "lowres_wide_intrinsics").mkdir(exist_ok=True)
        text = f"{camera.width} {camera.height} {camera.fx} {camera.fy} {camera.cx} {camera.cy}"
        (folder / "lowres_wide_intrinsics" / f"{name}.pincam").write_text(text)
        camera_from_world = np.linalg.inv(scene.pose(i))
        turn = Rotation.from_matrix(camera_from_world[:3, :3]).as_rotvec()
        lines.append(" ".join(map(repr, map(float, [round(scene.times_s[i], 3), *turn, *camera_from_world[:3, 3]]))))
    (folder / "lowres_wide.traj").write_text("\n".join(lines))
    return folder


def record3d(path: Path, scene: Scene, **metadata: object) -> Path:
    import imagecodecs

    camera = scene.camera
    poses = [[*quaternion(scene.pose(i) @ GL), *map(float, scene.pose(i)[:3, 3])] for i in range(len(scene.frames))]
    values = {
        **{"w": camera.width, "h": camera.height, "dw": camera.width // 2, "dh": camera.height // 2, "fps": 30},
        "K": [camera.fx, 0, 0, 0, camera.fy, 0, camera.cx, camera.cy, 1],
        "perFrameIntrinsicCoeffs": [[camera.fx, camera.fy, camera.cx, camera.cy]] * len(scene.frames),
        "poses": poses,
        "frameTimestamps": scene.times_s,
    }
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("metadata", json.dumps(values | metadata))
        for i, frame in enumerate(scene.frames):
            depth_m = scene.small_depth(i).astype(np.float32) * np.float32(0.001)
            depth_m[depth_m == 0] = np.nan
            archive.writestr(f"rgbd/{i}.jpg", jpeg(frame.color))
            archive.writestr(f"rgbd/{i}.depth", imagecodecs.lzfse_encode(depth_m.tobytes()))
            archive.writestr(f"rgbd/{i}.conf", imagecodecs.lzfse_encode(scene.confidence(depth_m).tobytes()))
    return path


def scannet(path: Path, scene: Scene, lost: Sequence[int] = (), shift_m: float = 0.0) -> Path:
    """`lost`: frames without a pose. `shift_m`: the depth lens stands this far to the right of that of colour."""
    camera, name = scene.camera, b"StructureSensor"
    matrix, extrinsics = np.eye(4, dtype="<f4"), np.eye(4, dtype="<f4")
    matrix[[0, 1, 0, 1], [0, 1, 2, 2]] = camera.fx, camera.fy, camera.cx, camera.cy
    small = matrix.copy()
    small[:2] /= 2
    small[:2, 2] -= 0.25
    extrinsics[0, 3] = shift_m
    parts = [struct.pack("<IQ", 4, len(name)), name]
    parts += [values.tobytes() for values in (matrix, np.eye(4, dtype="<f4"), small, extrinsics)]
    parts.append(struct.pack("<2i4If", 2, 1, camera.width, camera.height, camera.width // 2, camera.height // 2, 1000))
    parts.append(struct.pack("<Q", len(scene.frames)))
    for i, frame in enumerate(scene.frames):
        color, depth = jpeg(frame.color), zlib.compress(scene.small_depth(i).astype("<u2").tobytes())
        depth_pose = scene.pose(i) @ extrinsics
        pose = np.full((4, 4), -np.inf, "<f4") if i in lost else depth_pose.astype("<f4")
        time_us = round(scene.times_s[i] * 1e6)
        parts += [pose.tobytes(), struct.pack("<4Q", time_us, time_us, len(color), len(depth)), color, depth]
    parts.append(struct.pack("<Q", 0))
    path.write_bytes(b"".join(parts))
    return path
