"""A real hand that comes and goes in front of the real room: the hybrid geometry buffer and the volume alone."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from client.sources.frame_source import Source
from client.sources.volume import default_volume, default_voxel
from server.opencl.device import Device
from server.volume.bounds import Bounds
from tests.bench.geometry.hybrid import HandReport, measure_hand
from tests.bench.report.finished import Part
from tests.bench.truth.hand_frames import HandBefore

AFTERWARDS = 10
"""Frames looked at after the hand is gone."""
CASES = (
    ("hand", 1, False),
    ("hand with frayed rim and shadow", 1, True),
    ("hand five times slower", 5, False),
)
"""Name, frames that each hand picture is held, whether measured as structured light would. The first has the goals."""
_MARGIN_M = 0.1


def hand_part(device: Device, room: Source, pictures: Path, first: int, say: Callable[[str], None]) -> Part:
    """All cases, the hand entering at frame `first`."""
    part = Part()
    for name, hold, worn in CASES:
        say(f"{name}, with it and without")
        source = HandBefore(room, pictures, first, hold=hold, worn=worn)
        frames = range(source.frames_with_hand.stop + AFTERWARDS)
        found = measure_hand(device, room, source, *hand_volume(room, source), frames)
        part.sizes[f"frames of the {name}"] = len(source.frames_with_hand)
        _add_rows(part, name, found, has_goals=name == CASES[0][0])
        part.details[name] = {"iou": found.iou, "leftover_px": found.leftover_px}
    return part


def _add_rows(part: Part, name: str, found: HandReport, has_goals: bool) -> None:
    for kind, words in (("hybrid", "geometry buffer"), ("plain", "volume alone"), ("sensor", "sensor alone")):
        goals = (">= 0.95", "<= 0") if has_goals and kind == "hybrid" else ("", "")
        row, left = f"{name}, {words}", found.leftover_px[kind]
        part.add(f"{row}: IoU with its mask, worst frame", min(found.iou[kind]), "", goals[0])
        part.add(f"{row}: IoU with its mask, median", float(np.median(found.iou[kind])), "")
        part.add(f"{row}: pixels left in the first frame without it", left[0], "px", goals[1])
        part.add(f"{row}: pixels left in the {len(left) - 1} frames after that, most", max(left[1:]), "px")


def hand_volume(room: Source, source: HandBefore) -> tuple[Bounds, float]:
    """Box of what the room's camera sees and all of the hand, so that the volume can hold the hand; and the voxel size
    of the room alone."""
    seen = default_volume(room, range(source.frames_with_hand.stop))
    points = np.concatenate([_hand_points(room, source, i) for i in source.frames_with_hand])
    low = np.minimum(seen[:3], points.min(axis=0) - _MARGIN_M)
    high = np.maximum(seen[3:], points.max(axis=0) + _MARGIN_M)
    x0, y0, z0, x1, y1, z1 = (float(value) for value in (*low, *high))
    return (x0, y0, z0, x1, y1, z1), default_voxel(seen)


def _hand_points(room: Source, source: HandBefore, index: int) -> NDArray[np.float64]:
    """[n, 3] world metres, of every fourth pixel in both directions."""
    depth_m, camera, pose = source.hand_m(index)[::4, ::4], room.camera, room[index].world_from_camera
    assert pose is not None
    v, u = np.nonzero(depth_m)
    z = depth_m[v, u]
    points = np.stack([(4 * u - camera.cx) / camera.fx * z, (4 * v - camera.cy) / camera.fy * z, z], axis=1)
    moved: NDArray[np.float64] = points @ pose[:3, :3].T + pose[:3, 3]
    return moved
