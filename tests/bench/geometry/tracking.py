"""The camera followed by the volume alone, from the first pose on: against given poses, and beside a peer."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from client.sources.frame_source import Source
from client.sources.volume import default_volume, default_voxel
from server.opencl.device import Device
from server.opencl.engine import Engine
from server.volume.bounds import Bounds
from tests.bench.geometry.trajectory import Track, aligned_ate_rmse_m, ate_rmse_m, consistency, track_source
from tests.bench.peers.contestant import Scene
from tests.bench.peers.worker import ContestantLostError, Entry, Worker
from tests.bench.report.finished import Part

PEER = Entry("Open3D slam, point to plane", "tests.bench.peers.open3d_peer", "PointToPlane", "open3d")

Poses = list[NDArray[np.float64]]


def trajectory_rows(
    part: Part,
    device: Device,
    source: Source,
    name: str,
    count: int,
    goal_mm: float,
    say: Callable[[str], None],
    cube: tuple[Bounds, float] | None = None,
) -> None:
    """Rows of one source's first `count` frames. `cube`: bounds and voxel size, if not those that fit the source."""
    volume_m, voxel_m = cube or _fitting(source)
    truth = [_pose(source, i) for i in range(count)]
    say(f"trajectory: {name}, {count} frames, {1e3 * voxel_m:.1f} mm voxels")
    engine = Engine(device)
    try:
        track = track_source(engine, source, range(count), voxel_m, volume_m, "track")
        fits = {
            words: consistency(engine, source, poses, voxel_m, volume_m)
            for words, poses in (("tracked", track.poses), ("given", truth))
        }
    finally:
        engine.close()
    part.sizes[f"frames of {name} tracked"] = count
    _own_rows(part, name, track, truth, goal_mm)
    for words, fit in fits.items():
        row = f"{name}: depth against the volume fused at {words} poses"
        part.add(f"{row}, median", 1e3 * fit.median_m, "mm")
        part.add(f"{row}, within 2 cm", 100 * fit.within_2cm, "%")
    say(f"trajectory: {name}, {PEER.name}")
    _peer_row(part, source, name, truth, volume_m, voxel_m)


def _own_rows(part: Part, name: str, track: Track, truth: Poses, goal_mm: float) -> None:
    tracked = sum(status == "tracked" for status in track.statuses)
    part.add(f"{name}: ATE, first pose aligned", 1e3 * ate_rmse_m(track.poses, truth), "mm", f"<= {goal_mm:g}")
    part.add(f"{name}: ATE, all poses aligned", 1e3 * aligned_ate_rmse_m(track.poses, truth), "mm")
    part.add(f"{name}: frames tracked", 100 * tracked / len(truth), "%", ">= 100")
    part.add(f"{name}: tracking, median of its kernels' time", float(np.median(track.track_ms[1:])), "ms")


def _peer_row(part: Part, source: Source, name: str, truth: Poses, volume_m: Bounds, voxel_m: float) -> None:
    """Its error on the same frames, with the same voxels."""
    row = f"{name}: ATE, first pose aligned, {PEER.name}"
    absence = PEER.absence()
    if absence:
        part.leave_out(row, absence)
        return
    poses: Poses = []
    try:
        with Worker(PEER, Scene(source.camera, volume_m, voxel_m, truth[0])) as worker:
            for index in range(len(truth)):
                found = worker.process(source[index]).world_from_camera
                assert found is not None
                poses.append(found)
    except ContestantLostError as error:
        part.leave_out(row, f"frame {len(poses)}: {error}")
        return
    part.add(row, 1e3 * ate_rmse_m(poses, truth), "mm")


def _fitting(source: Source) -> tuple[Bounds, float]:
    volume_m = default_volume(source, range(len(source)))
    return volume_m, default_voxel(volume_m)


def _pose(source: Source, index: int) -> NDArray[np.float64]:
    pose = source[index].world_from_camera
    assert pose is not None
    return pose
