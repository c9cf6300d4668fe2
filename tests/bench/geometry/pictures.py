"""What `probeless bench geometry` draws: times as bars, the surface and its error, a hand that comes and goes."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import cv2
import numpy as np

from client.sources.frame_source import Source
from server.opencl.device import Device
from server.volume.bounds import Bounds
from tests.bench.geometry.hybrid import depth_of, run_geometry, vectors
from tests.bench.report.drawing import Picture, bars, depth_picture, difference_picture, normal_picture, side_by_side
from tests.bench.truth.hand_frames import HandBefore

LABEL_COLORS = np.array([(0, 0, 0), (170, 170, 170), (60, 60, 230), (60, 200, 230)], np.uint8)
"""BGR of none, static, dynamic, filled."""


def save(path: Path, picture: Picture) -> None:
    """Write a PNG. Raises OSError."""
    path.parent.mkdir(parents=True, exist_ok=True)
    if not cv2.imwrite(str(path), picture):
        raise OSError(f"{path} cannot be written")


def draw_times(path: Path, times_ms: Mapping[str, Mapping[str, float]], frames: int) -> None:
    """Everyone's medians as bars."""
    save(path, bars(f"640x480, 2 m cube, 7.8 mm voxels: median ms a frame of {frames}", times_ms))


def draw_surface(path: Path, device: Device, clean: Source, noisy: Source, bounds: Bounds, voxel_m: float) -> None:
    """What noisy depth looks like after 30 frames, and how far it is from the exact depth."""
    frames = range(30)
    exact = clean[frames[-1]].depth * clean.camera.depth_scale_m
    cells: list[tuple[str, Picture]] = []
    near, far = float(exact[exact > 0].min()), float(exact.max())
    for engine, index, seen in run_geometry(device, noisy, bounds, voxel_m, frames):
        if index == frames[-1]:
            sensor = engine.download(seen.measurement.depth_m)
            volume = depth_of(engine, seen.model, seen.volume_from_camera)
            normals = vectors(engine, seen.surface)[1][..., :3]
            cells = [
                ("the sensor's depth", depth_picture(sensor, near, far)),
                (f"the volume's, {len(frames)} frames", depth_picture(volume, near, far)),
                ("sensor - exact: red one voxel in front, blue behind", difference_picture(sensor, exact, voxel_m)),
                ("volume - exact", difference_picture(volume, exact, voxel_m)),
                ("normals of the geometry buffer", normal_picture(normals)),
            ]
    save(path, side_by_side(cells))


def draw_hand(path: Path, device: Device, source: HandBefore, bounds: Bounds, voxel_m: float) -> None:
    """A frame with the hand and the first one without it: what the sensor, the volume and the hybrid buffer show."""
    first, gone = source.frames_with_hand.start, source.frames_with_hand.stop
    shown = (first + 8, gone)
    cells = []
    for engine, index, seen in run_geometry(device, source, bounds, voxel_m, range(gone + 1)):
        if index in shown:
            sensor = engine.download(seen.measurement.depth_m)
            near, far = (float(x) for x in np.percentile(sensor[sensor > 0], (1, 99)))
            words = "with the hand" if index < gone else "first frame without it"
            labels = engine.download(seen.surface.labels)
            cells += [
                (f"camera, {words}", np.ascontiguousarray(source[index].color[..., ::-1])),
                ("sensor's depth", depth_picture(sensor, near, far)),
                ("volume alone", depth_picture(depth_of(engine, seen.model, seen.volume_from_camera), near, far)),
                ("hybrid buffer", depth_picture(depth_of(engine, seen.surface, seen.volume_from_camera), near, far)),
                ("normals", normal_picture(vectors(engine, seen.surface)[1][..., :3])),
                ("grey static, red dynamic, yellow filled", LABEL_COLORS[labels]),
            ]
    save(path, side_by_side(cells, columns=3))
