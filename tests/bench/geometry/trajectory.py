"""How well a camera was followed: absolute trajectory error (Sturm et al. 2012); a run of the geometry half alone."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from protocol.frames import CameraModel, RgbdFrame
from protocol.messages import Poses, Tracking, Wishes
from server.geometry.geometry import Geometry
from server.input.measure import measure
from server.maths.rigid import inverse_rigid
from server.opencl.engine import Engine
from server.volume.bounds import Bounds
from tests.bench.truth.rooms import seen_depth

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


def aligned_ate_rmse_m(estimated: list[Floats], truth: list[Floats]) -> float:
    """The same with all positions aligned as well as one rigid motion can (Sturm et al. 2012, eq. 3); by evo."""
    from evo.core.metrics import APE, PoseRelation, StatisticsType
    from evo.core.trajectory import PosePath3D

    moved, reference = PosePath3D(poses_se3=estimated), PosePath3D(poses_se3=truth)
    moved.align(reference)
    error = APE(PoseRelation.translation_part)
    error.process_data((reference, moved))
    return float(error.get_statistic(StatisticsType.rmse))


class Frames(Protocol):
    """A source of posed frames, as `client.sources.frame_source.Source` is one."""

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


@dataclass(frozen=True)
class Consistency:
    """How well depth pictures agree with the volume that all of them were fused into. Needs no truth."""

    median_m: float
    """Of the absolute difference in depth."""
    within_2cm: float
    """Share of the pixels that have both depths."""


def consistency(
    engine: Engine, source: Frames, poses: list[Floats], voxel_m: float, volume_m: Bounds, step: int = 5
) -> Consistency:
    """Fuse the first frames of `source` at `poses` (world_from_camera), then look at every `step`-th again."""
    geometry = Geometry(engine, source.camera, Wishes(voxel_m=voxel_m, volume_m=volume_m))
    for index, pose in enumerate(poses):
        geometry.scan(replace(source[index], world_from_camera=pose))
        engine.queue.finish()
        engine.profile.begin()
    assert geometry.volume is not None
    apart = []
    for index in range(0, len(poses), step):
        measured_m = engine.download(measure(engine, source.camera, source[index]).depth_m)
        seen_m = seen_depth(engine, geometry.volume, source.camera, poses[index])
        both = (measured_m > 0) & (seen_m > 0)
        apart.append(np.abs(measured_m - seen_m)[both])
    off = np.concatenate(apart)
    return Consistency(float(np.median(off)), float((off < 0.02).mean()))


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
        result = geometry.scan(source[index])
        engine.queue.finish()
        kernel_ms = engine.profile.collect().kernels
        track.poses.append(result.world_from_camera)
        track.statuses.append(result.tracking)
        track.notes.append(result.notes)
        track.track_ms.append(sum(kernel_ms.get(name, 0.0) for name in TRACK_KERNELS))
        progress(done + 1, len(frames))
    return track
