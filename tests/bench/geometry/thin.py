"""Thin structures in the geometry buffer: rods with exact truth measured, a chair of tubes drawn."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from client.sources.frame_source import Source
from client.sources.volume import default_volume, default_voxel
from client.synthetic.sensor_noise import kinect_like
from server.opencl.device import Device
from tests.bench.geometry.hybrid import depth_of, run_geometry, vectors
from tests.bench.geometry.pictures import LABEL_COLORS, save
from tests.bench.report.drawing import Picture, depth_picture, normal_picture, side_by_side
from tests.bench.report.finished import Part
from tests.bench.truth.rods import CAMERA, RodsBefore, measure_rods, thickness_m


@dataclass(frozen=True)
class RodCase:
    """One kind of rods."""

    name: str
    width_px: float
    speed_m: float
    """A frame."""
    same_color: bool = False
    noisy: bool = False
    """Measured as a Kinect would, not exactly."""
    held: bool = True
    """Whether the geometry buffer is held to the goals."""


VOXEL_M = 0.01
SPEED_M = 0.025
LEARNED = 15
"""Frames until the volume has what stands still; also before what moves is looked at, so that it knows the wall."""
CASES = (
    RodCase("2 px wide, still", 2.0, 0.0),
    RodCase("2 px wide, moving", 2.0, SPEED_M),
    RodCase("2 px wide, moving, sensor with noise", 2.0, SPEED_M, noisy=True),
    RodCase("3 px wide, moving, as bright as the wall", 3.0, SPEED_M, same_color=True),
    RodCase("2 px wide, moving, as bright as the wall", 2.0, SPEED_M, same_color=True, held=False),
)
"""The last is beyond eq. 4.4: the joint median of the 5 x 5 pixels that look alike sides with the wall."""
KEPT_GOAL, ADDED_GOAL = ">= 98", "<= 1"

CHAIR_SOURCE, CHAIR_FRAME = "rgbd_livingroom1_synth", 40
CHAIR = (slice(112, 428), slice(212, 492))
"""Rows and columns of the living room's chair in that frame."""
_CELL_PX = 400


def add_rod_rows(part: Part, device: Device, measured: int, say: Callable[[str], None]) -> None:
    """Of `measured` frames: pixels of the rods that are kept, and pixels beside them that are added."""
    part.sizes["frames of rods"] = measured
    for case in CASES:
        say(f"rods {case.name}")
        sensor, frames = _noisy if case.noisy else None, LEARNED + measured
        source = RodsBefore(thickness_m(case.width_px), CAMERA, case.speed_m, case.same_color, sensor, frames)
        found = measure_rods(device, source, VOXEL_M, LEARNED)
        for kind, words in (("hybrid", "geometry buffer"), ("plain", "volume alone"), ("sensor", "sensor alone")):
            goals = (KEPT_GOAL, ADDED_GOAL) if kind == "hybrid" and case.held else ("", "")
            row = f"rods {case.name}, {words}"
            part.add(f"{row}: pixels kept, worst frame", 100 * min(found.kept[kind]), "%", goals[0])
            part.add(f"{row}: pixels added, worst frame", 100 * max(found.added[kind]), "%", goals[1])


def _noisy(depth_m: NDArray[np.float64], index: int) -> NDArray[np.float64]:
    return kinect_like(depth_m, np.ones_like(depth_m), CAMERA.fx, index)


def draw_thin(path: Path, device: Device, room: Source) -> None:
    """The chair of tubes in CHAIR_SOURCE: what the sensor, the volume and the geometry buffer show of it."""
    frames = range(CHAIR_FRAME + 1)
    volume_m = default_volume(room, frames)
    cells: list[tuple[str, Picture]] = []
    for engine, index, seen in run_geometry(device, room, volume_m, default_voxel(volume_m), frames):
        if index != CHAIR_FRAME:
            continue
        pose = seen.volume_from_camera
        sensor = engine.download(seen.measurement.depth_m)
        near, far = (float(x) for x in np.percentile(sensor[CHAIR][sensor[CHAIR] > 0], (0, 100)))
        plain, hybrid = (depth_of(engine, surface, pose) for surface in (seen.model, seen.surface))
        normals = vectors(engine, seen.surface)[1][..., :3] @ (pose[:3, :3] * (1, -1, -1))  # up is green
        cells = [
            ("camera", room[index].color[..., ::-1]),
            ("sensor's depth", depth_picture(sensor, near, far)),
            ("volume alone, torn", depth_picture(plain, near, far)),
            ("hybrid buffer", depth_picture(hybrid, near, far)),
            ("normals of it", normal_picture(normals)),
            ("grey static, red dynamic, yellow filled", LABEL_COLORS[engine.download(seen.surface.labels)]),
        ]
    save(path, side_by_side([(name, _enlarged(picture[CHAIR])) for name, picture in cells], columns=3))


def _enlarged(picture: Picture) -> Picture:
    height, width = picture.shape[:2]
    size = (_CELL_PX, round(height * _CELL_PX / width))
    return cv2.resize(np.ascontiguousarray(picture), size, interpolation=cv2.INTER_NEAREST).astype(np.uint8)
