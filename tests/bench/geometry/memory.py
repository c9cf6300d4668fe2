"""What a room costs in memory, and whether it is the same room when most of it lies on the host."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from pathlib import Path
from zlib import crc32

import numpy as np
from numpy.typing import NDArray

from server.opencl.device import Device
from server.opencl.engine import Engine
from server.volume.volume import Volume
from tests.bench.truth.rooms import CAMERA, LIVING_ROOM, fuse_frame, seen_depth, walk

Floats = NDArray[np.float64]
VOXEL_M = 0.01
_MARGIN_M = 0.05
_SMALL_BUDGET = 96 << 20


def room_memory(device: Device, progress: Callable[[str], None], frames: int = 240) -> dict[str, float]:
    """A room of 6x3x6 m at 1 cm, walked through, in one engine with the default budget and in one with 96 MB.

    `growth_mb` is the process's memory at its greatest less what it was before the walk (kernels were compiled then);
    `resident_mb` all of the process at its greatest. Both are NaN where the system does not tell.
    `small_differing_bricks` counts bricks whose tsdf or weight differ in any bit. What rays find may move by a
    hundredth of a voxel: they start elsewhere where fewer bricks are resident.
    """
    poses = walk(frames)
    _walk(device, poses[:1], 512 << 20, progress, "warming up")
    before = _start_peak()
    figures, large, large_bricks = _walk(device, poses, 512 << 20, progress, "default budget")
    peak = _peak_mb()
    small_figures, small, small_bricks = _walk(device, poses, _SMALL_BUDGET, progress, "96 MB")
    differs = np.abs(large - small)
    return {
        "growth_mb": peak - before,
        "resident_mb": peak,
        **figures,
        **{f"small_{name}": value for name, value in small_figures.items()},
        "small_differing_bricks": float(len(large_bricks.items() ^ small_bricks.items())),
        "small_differing_pixels": float((differs > 0).mean()),
        "small_greatest_difference_voxels": float(differs.max() / VOXEL_M),
    }


def _walk(
    device: Device, poses: Sequence[Floats], budget: int, progress: Callable[[str], None], name: str
) -> tuple[dict[str, float], Floats, dict[bytes, int]]:
    """Fuse a walk; figures, the depth that some of its poses then see, [n, h, w], and checksums of bricks by place."""
    engine, size = Engine(device), np.array(LIVING_ROOM.size_m)
    low, high = (-_MARGIN_M * np.ones(3)).tolist(), (size + _MARGIN_M).tolist()
    volume = Volume(engine, (*low, *high), VOXEL_M, budget)
    most_released = full_frames = 0
    for index, pose in enumerate(poses):
        fuse_frame(engine, volume, CAMERA, LIVING_ROOM.frame(index, CAMERA, pose))
        engine.queue.finish()
        engine.profile.begin()
        most_released, full_frames = max(most_released, volume.released_bricks), full_frames + volume.is_full
        if index % 20 == 0:
            progress(f"room memory, {name}: frame {index} of {len(poses)}, {volume.allocated_bricks} bricks")
    device_bytes, host_bytes, bricks = volume.device_bytes, volume.host_bytes, volume.allocated_bricks
    chosen = poses[:: max(len(poses) // 8, 1)]
    found = np.stack([seen_depth(engine, volume, CAMERA, pose) for pose in chosen])
    true = np.stack([LIVING_ROOM.depth_m(CAMERA, pose) for pose in chosen])
    checksums = _checksums(volume)
    engine.close()
    return (
        {
            "device_mb": device_bytes / 1e6,
            "host_mb": host_bytes / 1e6,
            "bricks": float(bricks),
            "most_released_bricks": float(most_released),
            "full_frames": float(full_frames),
            "covered": float((found > 0).mean()),
            "median_error_voxels": float(np.median(np.abs(found - true)[found > 0]) / VOXEL_M),
        },
        found,
        checksums,
    )


def _checksums(volume: Volume) -> dict[bytes, int]:
    """Of tsdf and weight of every brick, by its coordinates."""
    return {
        place.tobytes(): crc32(weight.tobytes(), crc32(tsdf.tobytes()))
        for batch in volume.download_batches()
        for place, tsdf, weight in zip(batch.indices, batch.tsdf, batch.weight, strict=True)
    }


def _start_peak() -> float:
    """Forget the greatest size so far; resident megabytes now, NaN where the system does not tell."""
    try:
        Path("/proc/self/clear_refs").write_text("5")  # Linux: VmHWM starts anew
    except OSError:
        return float("nan")
    return _status_mb("VmRSS")


def _peak_mb() -> float:
    return _status_mb("VmHWM")


def _status_mb(name: str) -> float:
    status = Path(f"/proc/{os.getpid()}/status")
    if not status.exists():
        return float("nan")
    lines = dict(line.split(":", 1) for line in status.read_text().splitlines())
    return float(lines[name].split()[0]) * 1024 / 1e6
