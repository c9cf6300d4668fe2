"""This program and its peers on the same frames, turn by turn in one run, so that all meet the machine in one state."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field
from statistics import median

import numpy as np
from numpy.typing import NDArray

from protocol.frames import RgbdFrame
from tests.bench.geometry.surface import SurfaceView, inside_bounds, surface_accuracy
from tests.bench.peers.contestant import ACTIONS, FILTER, INTEGRATE, RAYCAST, TRACK, Scene, Turn
from tests.bench.peers.worker import ContestantLostError, Entry, Worker
from tests.bench.report.finished import Part

WARM_UP = 8
"""First frames, whose times do not count: compilers, caches and memory on first use."""
GREATEST_ERROR_VOXELS, LEAST_COVERED = 1.0, 0.5
"""Whose surface is farther off or emptier does not fuse what it was given: its times say nothing."""

_PEERS = "tests.bench.peers."
OURS, OURS_TRACKING = "probeless", "probeless tracking"
GRIDS = ("Open3D VoxelBlockGrid, blocks of 8", "Open3D VoxelBlockGrid, blocks of 16")
ENTRIES = (
    Entry(OURS, _PEERS + "probeless_peer", "GivenPoses", kind="CPU"),
    Entry(GRIDS[0], _PEERS + "open3d_peer", "BlockGrid8", "open3d"),
    Entry(GRIDS[1], _PEERS + "open3d_peer", "BlockGrid16", "open3d"),
    Entry(OURS_TRACKING, _PEERS + "probeless_peer", "Tracking", kind="CPU"),
    Entry("probeless on a GPU", _PEERS + "probeless_peer", "OnGpu", kind="GPU"),
    Entry("Open3D UniformTSDFVolume", _PEERS + "open3d_peer", "UniformVolume", "open3d"),
    Entry("OpenCV Volume TSDF", _PEERS + "opencv_peer", "DenseVolume"),
    Entry("OpenCV Volume HashTSDF", _PEERS + "opencv_peer", "HashVolume"),
    Entry("Open3D slam, point to plane", _PEERS + "open3d_peer", "PointToPlane", "open3d"),
    Entry("Open3D slam, hybrid", _PEERS + "open3d_peer", "Hybrid", "open3d"),
    Entry("OpenCV Odometry, depth, frame to frame", _PEERS + "opencv_peer", "DepthOdometry"),
)


@dataclass
class Score:
    """What one contestant did."""

    turns: list[Turn] = field(default_factory=list)
    views: list[SurfaceView] = field(default_factory=list)
    lost: str = ""
    """Why its times do not count."""

    def ms(self, action: str, cpu: bool = False) -> list[float]:
        """Of every frame after the warm-up."""
        times = [turn.cpu_ms if cpu else turn.wall_ms for turn in self.turns[WARM_UP:]]
        return [item[action] for item in times if action in item]


def play(
    scene: Scene, frames: Sequence[RgbdFrame], exact_m: Sequence[NDArray[np.floating]], say: Callable[[str], None]
) -> dict[str, Score]:
    """All contestants, frame by frame; their surfaces are looked at in the middle and at the end."""
    scores: dict[str, Score] = {entry.name: Score(lost=entry.absence() or "") for entry in ENTRIES}
    with ExitStack() as stack:
        workers = [stack.enter_context(Worker(entry, scene)) for entry in ENTRIES if not scores[entry.name].lost]
        for i, frame in enumerate(frames):
            for worker in workers:
                score = scores[worker.entry.name]
                if not score.lost:
                    _turn(worker, score, scene, frame, exact_m[i] if i in {len(frames) // 2, len(frames) - 1} else None)
            if (i + 1) % 10 == 0:
                say(f"{i + 1} of {len(frames)} frames, load average {os.getloadavg()[0]:.1f}")
    for score in scores.values():
        score.lost = score.lost or fault(score.views, scene.voxel_m)
    return scores


def _turn(worker: Worker, score: Score, scene: Scene, frame: RgbdFrame, exact_m: NDArray[np.floating] | None) -> None:
    try:
        score.turns.append(worker.process(frame))
        depth_m = None if exact_m is None else worker.depth(frame)
    except ContestantLostError as error:
        score.lost = str(error)
        return
    if exact_m is not None and depth_m is not None:
        assert frame.world_from_camera is not None
        inside = inside_bounds(scene.camera, frame.world_from_camera, exact_m, scene.bounds_m, scene.voxel_m)
        score.views.append(SurfaceView(depth_m, exact_m, inside))


def fault(views: Sequence[SurfaceView], voxel_m: float) -> str:
    """Why a surface does not count; empty where it does, or where there is none to look at."""
    if not views:
        return ""
    found = surface_accuracy(views, voxel_m)
    if found.median_voxels <= GREATEST_ERROR_VOXELS and found.covered >= LEAST_COVERED:
        return ""
    return f"its surface covers {found.covered:.0%} of the picture, {found.median_voxels:.2f} voxels off: no fair time"


def contest_part(scores: dict[str, Score], voxel_m: float, truth: NDArray[np.float64]) -> Part:
    """Rows of times, surfaces and trajectories, and the ratios this program is held to. truth: [n, 4, 4] poses."""
    part = Part(sizes={"frames timed": max(len(score.turns) for score in scores.values()) - WARM_UP})
    for name, score in scores.items():
        if score.lost:
            part.leave_out(name, score.lost)
            continue
        for action in ACTIONS:
            times = score.ms(action)
            if times:
                part.add(f"{name}: {action}, median", median(times), "ms")
                part.add(f"{name}: {action}, minimum", min(times), "ms")
                part.add(f"{name}: {action}, processor time, median", median(score.ms(action, cpu=True)), "ms")
        if score.views:
            found = surface_accuracy(score.views, voxel_m)
            part.add(f"{name}: surface, median error", found.median_voxels, "voxels")
            part.add(f"{name}: surface, pixels covered", 100 * found.covered, "%")
        poses = [turn.world_from_camera for turn in score.turns if turn.world_from_camera is not None]
        if poses:
            off = np.linalg.norm(np.array(poses)[:, :3, 3] - truth[: len(poses), :3, 3], axis=1)
            part.add(f"{name}: ATE in this run", 1e3 * float(np.sqrt((off**2).mean())), "mm")
    _add_ratios(part, scores)
    part.details["wall_ms"] = {name: _means(score) for name, score in scores.items() if not score.lost}
    return part


def _add_ratios(part: Part, scores: dict[str, Score]) -> None:
    """Against the faster of Open3D's grids. Processor time is held to the goal as well: load distorts wall times."""
    grids = [scores[name] for name in GRIDS if not scores[name].lost]
    ours = (
        (OURS, (INTEGRATE, RAYCAST), f"{INTEGRATE} + {RAYCAST}", "<= 0.5"),
        (OURS_TRACKING, (TRACK,), TRACK, "<= 0.18"),
        (OURS_TRACKING, (TRACK, FILTER), f"{FILTER} + {TRACK}", ""),
    )
    measures: tuple[tuple[str, Callable[[list[float]], float], bool], ...] = (
        ("", median, False),
        (", minima", min, False),
        (", processor time", median, True),
    )
    for name, actions, words, goal in ours:
        row = f"{words}, {OURS} / Open3D VoxelBlockGrid {INTEGRATE} + {RAYCAST}"
        if scores[name].lost or not grids:
            part.leave_out(row, scores[name].lost or scores[GRIDS[0]].lost)
            continue
        for suffix, pick, cpu in measures:
            theirs = min(_sum(grid, (INTEGRATE, RAYCAST), pick, cpu) for grid in grids)
            held = "" if pick is min else goal
            part.add(row + suffix, _sum(scores[name], actions, pick, cpu) / theirs, "", held)


def _sum(score: Score, actions: Sequence[str], pick: Callable[[list[float]], float], cpu: bool) -> float:
    return sum(pick(score.ms(action, cpu)) for action in actions)


def _means(score: Score) -> dict[str, float]:
    return {action: median(score.ms(action)) for action in ACTIONS if score.ms(action)}
