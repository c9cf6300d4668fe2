"""How well a camera was followed: absolute trajectory error (Sturm et al. 2012); a run of the geometry half alone."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from protocol.frames import CameraModel, RgbdFrame
from protocol.messages import Poses, Tracking, Wishes
from server.geometry import Geometry
from server.maths.rigid import inverse_rigid
from server.opencl.engine import Engine
from server.settings import Bounds

Floats = NDArray[np.float64]

TRACK_KERNELS = ("halve_depth", "view_model", "sum_equations")


def ate_rmse_m(estimated: list[Floats], truth: list[Floats]) -> float:
    """Root mean square distance in metres of world_from_camera [4, 4] to the true ones, the first pose aligned.

    Stricter than aligning the whole trajectory: an early error counts on every later frame.
    """
    return float(np.sqrt(np.mean(position_errors_m(estimated, truth) ** 2)))


def position_errors_m(estimated: list[Floats], truth: list[Floats]) -> Floats:
    """[n] metres between estimated and true positions, the first pose aligned."""
    if len(estimated) != len(truth) or not truth:
        raise ValueError(f"{len(estimated)} estimated poses for {len(truth)} true ones")
    align = truth[0] @ inverse_rigid(estimated[0])
    return np.array([np.linalg.norm((align @ a - b)[:3, 3]) for a, b in zip(estimated, truth, strict=True)])


class Frames(Protocol):
    """A source of posed frames, as `client.laptop.source.Source` is one."""

    @property
    def camera(self) -> CameraModel: ...

    def __getitem__(self, index: int) -> RgbdFrame: ...


@dataclass(frozen=True)
class Track:
    """What tracking made of a source; one entry a frame."""

    poses: list[Floats]
    """world_from_camera; where it was lost, the last good one."""
    statuses: list[Tracking]
    notes: list[tuple[str, ...]]
    track_ms: list[float]
    """Device time of the tracker's own kernels: pyramid, view of the model, all iterations; no filter."""


def track_source(
    engine: Engine,
    source: Frames,
    frames: Sequence[int],
    voxel_m: float,
    volume_m: Bounds,
    mode: Poses,
    progress: Callable[[int, int], None] = lambda _done, _total: None,
) -> Track:
    """Run the geometry half alone over `frames` of `source`."""
    geometry = Geometry(engine, source.camera, Wishes(poses=mode, voxel_m=voxel_m, volume_m=volume_m))
    track = Track([], [], [], [])
    for done, index in enumerate(frames):
        result = geometry.update(source[index])
        engine.queue.finish()
        _, kernel_ms = engine.profile.collect()
        track.poses.append(result.world_from_camera)
        track.statuses.append(result.tracking)
        track.notes.append(result.notes)
        track.track_ms.append(sum(kernel_ms.get(name, 0.0) for name in TRACK_KERNELS))
        progress(done + 1, len(frames))
    return track
