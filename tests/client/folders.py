"""Tiny data sets in each layout, made by the tests themselves."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

WIDTH, HEIGHT = 32, 24


def color_of(index: int, dtype: type = np.uint8) -> NDArray:
    """[h, w, 3] RGB, red to the right, green downwards, blue by frame."""
    scale = 1 if dtype is np.uint8 else 256
    picture = np.zeros((HEIGHT, WIDTH, 3), dtype)
    picture[..., 0] = np.arange(WIDTH) * 8 * scale
    picture[..., 1] = np.arange(HEIGHT)[:, None] * 10 * scale
    picture[..., 2] = (40 + 10 * index) * scale
    return picture


def depth_of(index: int) -> NDArray[np.uint16]:
    """[h, w] uint16: a slope from 1000 on, one pixel without measurement marked 0, one marked 65535."""
    depth = np.full((HEIGHT, WIDTH), 1000 + index, np.uint16) + np.arange(WIDTH, dtype=np.uint16)
    depth[0, 0], depth[1, 1] = 0, 65535
    return depth


def pose_of(index: int) -> NDArray[np.float64]:
    """[4, 4] turned by 10 degrees a frame about y and moved along x."""
    angle = np.radians(10 * index)
    pose = np.eye(4)
    pose[:3, :3] = [[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]]
    pose[:3, 3] = (0.1 * index, 0.2, 0.3)
    return pose


def write_picture(path: Path, picture: NDArray) -> None:
    """PNG or JPEG by the suffix; [h, w, 3] is RGB."""
    path.parent.mkdir(parents=True, exist_ok=True)
    stored = cv2.cvtColor(picture, cv2.COLOR_RGB2BGR) if picture.ndim == 3 else picture
    assert cv2.imwrite(str(path), stored, [cv2.IMWRITE_JPEG_QUALITY, 98])


def tum_line(time_s: float, pose: NDArray[np.float64]) -> str:
    """A rotation about y only, as `pose_of` makes them."""
    half = np.arctan2(pose[0, 2], pose[0, 0]) / 2
    return f"{time_s:.6f} {pose[0, 3]} {pose[1, 3]} {pose[2, 3]} 0 {np.sin(half)} 0 {np.cos(half)}\n"


def seven_scenes(folder: Path, count: int = 3, inner: str = "data") -> Path:
    data = folder / inner
    for i in range(count):
        write_picture(data / f"frame-{i:06d}.color.png", color_of(i))
        write_picture(data / f"frame-{i:06d}.depth.png", depth_of(i))
        np.savetxt(data / f"frame-{i:06d}.pose.txt", pose_of(i))
    np.savetxt(data / "camera-intrinsics.txt", [[30, 0, 15.5], [0, 31, 11.5], [0, 0, 1]])
    return folder


def redwood(folder: Path, count: int = 3) -> Path:
    log = []
    for i in range(count):
        write_picture(folder / "color" / f"{i:05d}.jpg", color_of(i))
        write_picture(folder / "depth" / f"{i:05d}.png", depth_of(i))
        rows = "\n".join(" ".join(map(str, row)) for row in pose_of(i))
        log.append(f"{i} {i} {i + 1}\n{rows}\n")
    (folder / "trajectory.log").write_text("".join(log))
    matrix = [30.0, 0, 0, 0, 31.0, 0, 15.5, 11.5, 1]
    intrinsic = {"width": WIDTH, "height": HEIGHT, "intrinsic_matrix": matrix}
    (folder / "camera_primesense.json").write_text(json.dumps(intrinsic))
    return folder


def tum(folder: Path, count: int = 3) -> Path:
    """Colour every 0.1 s, depth 5 ms later, poses every 10 ms; one colour picture more that has no depth."""
    rgb, depth, truth = ["# color\n"], ["# depth\n"], ["# poses\n"]
    for i in range(count):
        write_picture(folder / "rgb" / f"{i}.png", color_of(i))
        write_picture(folder / "depth" / f"{i}.png", depth_of(i))
        rgb.append(f"{100 + 0.1 * i:.6f} rgb/{i}.png\n")
        depth.append(f"{100 + 0.1 * i + 0.005:.6f} depth/{i}.png\n")
        truth += [tum_line(100 + 0.1 * i + 0.01 * k, pose_of(i)) for k in (-4, 0, 4)]
    rgb.append(f"{100 + 0.1 * count:.6f} rgb/none.png\n")
    (folder / "rgb.txt").write_text("".join(rgb))
    (folder / "depth.txt").write_text("".join(depth))
    (folder / "groundtruth.txt").write_text("".join(truth))
    return folder


def ground_truth(folder: Path, count: int = 3, encoding: str = "srgb8") -> Path:
    """meta.json in `folder`, its pictures beside it and above it."""
    dtype = np.uint8 if encoding == "srgb8" else np.uint16
    for i in range(count):
        write_picture(folder / "color" / f"{i:06d}.png", color_of(i, dtype))
        write_picture(folder.parent / "shared_depth" / f"{i:06d}.png", depth_of(i))
    (folder / "poses.txt").write_text("# poses\n" + "".join(tum_line(i / 25, pose_of(i)) for i in range(count)))
    meta = {
        "camera": {"width": WIDTH, "height": HEIGHT, "fx": 30.0, "fy": 31.0, "cx": 15.5, "cy": 11.5},
        "depth_scale_m": 0.0005,
        "frames": count,
        "color": "color",
        "depth": "../shared_depth",
        "poses": "poses.txt",
        "color_encoding": encoding,
        "up": [0, -1, 0],
    }
    (folder / "meta.json").write_text(json.dumps(meta))
    return folder
