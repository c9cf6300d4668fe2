"""Measures the hybrid geometry buffer (thesis 4.2.2): a hand in front of a room, thin structures, normals."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from protocol.messages import Wishes
from server.geometry.geometry import Geometry, GeometryFrame
from server.opencl.device import Device
from server.opencl.engine import Engine
from server.volume.bounds import Bounds
from server.volume.raycast import Surface
from tests.bench.truth.hand_frames import Frames, HandBefore

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]


def agreement_m(depth_m: Floats, voxel_m: float) -> Floats:
    """lambda_D of the thesis, as agreement.clh has it."""
    return 1.5 * voxel_m + 4 * (0.0012 + 0.0019 * (depth_m - 0.4) ** 2)


def vectors(engine: Engine, surface: Surface) -> tuple[Floats, Floats]:
    """Positions and normals [h, w, 4] on the host."""
    positions, normals = (engine.download(array) for array in (surface.positions, surface.normals))
    return (
        positions.view(np.float32).reshape(*positions.shape, 4).astype(np.float64),
        normals.view(np.float32).reshape(*normals.shape, 4).astype(np.float64),
    )


def depth_of(engine: Engine, surface: Surface, volume_from_camera: Floats) -> Floats:
    """[h, w] depth of a surface along the optical axis, metres, 0 = none."""
    positions, _ = vectors(engine, surface)
    depth: Floats = (positions[..., :3] - volume_from_camera[:3, 3]) @ volume_from_camera[:3, 2]
    return np.where(positions[..., 3] > 0, depth, 0)


# ---- a hand --------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Views:
    """Three depth pictures [h, w] of one frame, metres, 0 = none."""

    sensor: Floats
    plain: Floats
    """The volume alone."""
    hybrid: Floats


@dataclass
class HandReport:
    """Silhouettes while the hand is there, one figure a frame, and what is left of it when it is gone.

    Each under the name of a depth picture: sensor, plain (the volume alone), hybrid.
    """

    iou: dict[str, list[float]] = field(default_factory=dict)
    depth_error_m: dict[str, list[float]] = field(default_factory=dict)
    """Median error within the silhouette."""
    leftover_px: dict[str, list[int]] = field(default_factory=dict)
    """Pixels of the hand in the first, second, ... frame without it."""


def silhouette(seen_m: Floats, without_m: Floats, hand_m: Floats, voxel_m: float, farthest_m: float) -> Bools:
    """[h, w] where a depth picture shows the hand.

    Where the hand is: at its depth to within lambda_D. Elsewhere: no farther than the hand's farthest point, and nearer
    by lambda_D than the same picture `without` it, or that knows nothing.
    """
    there = hand_m > 0
    at_hand = np.abs(seen_m - hand_m) < agreement_m(hand_m, voxel_m)
    in_front = (without_m == 0) | (without_m - seen_m > agreement_m(without_m, voxel_m))
    return (seen_m > 0) & np.where(there, at_hand, in_front & (seen_m <= farthest_m))


def measure_hand(
    device: Device, room: Frames, source: HandBefore, volume_m: Bounds, voxel_m: float, frames: range
) -> HandReport:
    """Follow `frames` of `source` and, beside it, of the same `room` without the hand: the truth it is held against."""
    report = HandReport()
    farthest_m = 0.0
    for index, (seen, without) in zip(
        frames,
        zip(
            follow(device, source, volume_m, voxel_m, frames),
            follow(device, room, volume_m, voxel_m, frames),
            strict=True,
        ),
        strict=True,
    ):
        hand_m = source.hand_m(index)
        mask = hand_m > 0
        farthest_m = max(farthest_m, float(hand_m.max()))
        for name in ("sensor", "plain", "hybrid"):
            picture, clean = getattr(seen, name), getattr(without, name)
            shown = silhouette(picture, clean, hand_m, voxel_m, farthest_m)
            if mask.any():
                error = np.abs(picture - hand_m)[mask & shown]
                report.iou.setdefault(name, []).append(float((shown & mask).sum() / (shown | mask).sum()))
                report.depth_error_m.setdefault(name, []).append(float(np.median(error)) if error.size else np.inf)
            elif index >= source.frames_with_hand.stop:
                report.leftover_px.setdefault(name, []).append(int(shown.sum()))
    return report


def follow(device: Device, source: Frames, volume_m: Bounds, voxel_m: float, frames: range) -> Iterator[Views]:
    """The depth pictures of a source's frames, one after the other."""
    for engine, _, frame in run_geometry(device, source, volume_m, voxel_m, frames):
        pose = frame.volume_from_camera
        sensor = engine.download(frame.measurement.depth_m).astype(np.float64)
        yield Views(sensor, depth_of(engine, frame.model, pose), depth_of(engine, frame.surface, pose))


def run_geometry(
    device: Device, source: Frames, volume_m: Bounds, voxel_m: float, frames: range
) -> Iterator[tuple[Engine, int, GeometryFrame]]:
    """The geometry half of the spine over a source, with the poses it gives."""
    engine = Engine(device)
    try:
        geometry = Geometry(engine, source.camera, Wishes(volume_m=volume_m, voxel_m=voxel_m))
        for index in frames:
            yield engine, index, geometry.scan(source[index])
    finally:
        engine.close()
