"""Several calibrated cameras into one volume: how much of the surface depends on the order of their pictures."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from protocol.frames import CameraModel, RgbdFrame
from server.opencl.device import Device
from server.opencl.engine import Engine
from server.volume.volume import Volume
from tests.bench.truth.rooms import LIVING_ROOM, fuse_frame, looking, seen_depth

Floats = NDArray[np.float64]
VOXEL_M = 0.015
BOUNDS_M = (1.5, 1.4, 3.6, 4.5, 3.05, 6.05)
"""A table before a wall."""
NOISE = 0.0015
"""Standard deviation of depth at 1 m, growing with its square: a structured-light camera's."""


@dataclass(frozen=True)
class Station:
    """One camera and where it stands."""

    camera: CameraModel
    world_from_camera: Floats
    """As it says."""
    seen_from: Floats
    """Where it truly is."""


def stations(offset_m: float = 0.0) -> list[Station]:
    """Three cameras of different lenses and sizes around the table; the second stands `offset_m` beside it."""
    cameras = (
        CameraModel(width=320, height=240, fx=262.5, fy=262.5, cx=159.5, cy=119.5, depth_scale_m=0.0005),
        CameraModel(width=256, height=192, fx=190.0, fy=192.0, cx=131.0, cy=92.5, depth_scale_m=0.00025),
        CameraModel(width=424, height=240, fx=370.0, fy=370.0, cx=211.5, cy=119.5, depth_scale_m=0.0005),
    )
    poses = (
        looking((3.0, 1.6, 2.6), 0.0, -0.3),
        looking((1.9, 1.7, 3.2), 0.55, -0.3),
        looking((4.3, 1.5, 3.1), -0.5, -0.3),
    )
    placed = []
    for index, (camera, pose) in enumerate(zip(cameras, poses, strict=True)):
        truly = pose.copy()
        truly[:3, 3] += (index == 1) * offset_m * pose[:3, 0]
        placed.append(Station(camera, pose, truly))
    return placed


def orders(pictures: int, seed: int = 1) -> dict[str, list[tuple[int, int]]]:
    """The same pictures (camera, number) of three cameras in several orders."""
    turns = [(camera, number) for number in range(pictures) for camera in range(3)]
    shuffled = [turns[i] for i in np.random.default_rng(seed).permutation(len(turns))]
    return {"ABCABC": turns, "AABBCC": sorted(turns), "CCBBAA": sorted(turns, reverse=True), "shuffled": shuffled}


def fuse_in_order(
    device: Device,
    placed: Sequence[Station],
    order: Sequence[tuple[int, int]],
    noise: float,
    views: Sequence[Station] | None = None,
) -> list[Floats]:
    """Depth [h, w] metres that each of `views` (default, the stations) then sees of the volume, 0 = nothing."""
    engine = Engine(device)
    volume = Volume(engine, BOUNDS_M, VOXEL_M)
    true = [LIVING_ROOM.depth_m(station.camera, station.seen_from) for station in placed]
    for camera, number in order:
        station = placed[camera]
        random = np.random.default_rng((camera, number))
        depth = true[camera] + noise * true[camera] ** 2 * random.normal(size=true[camera].shape)
        fuse_frame(engine, volume, station.camera, _frame(number, station, depth))
    found = [seen_depth(engine, volume, station.camera, station.world_from_camera) for station in views or placed]
    engine.close()
    return found


def interleaving_spread(device: Device, progress: Callable[[str], None], pictures: int = 40) -> dict[str, float]:
    """Over four orders of the same pictures, in voxels: how far apart the surfaces lie, at pixels that all orders see.

    Of exact and of noisy depth. A mean that forgets after 64 pictures depends on the order of more of them. At edges a
    pixel may see the table in one order and what lies behind in another: `far_apart` is the share of those. `error` is
    the median distance to the truth. `offset_*`: one camera stands 2 cm beside where it says; how far the surface moves
    that the first camera sees, and the share of its pixels that lose it.
    """
    figures: dict[str, float] = {}
    placed = stations()
    true = [LIVING_ROOM.depth_m(station.camera, station.world_from_camera) for station in placed]
    for name, noise in (("exact", 0.0), ("noisy", NOISE)):
        found = []
        for order_name, order in orders(pictures).items():
            progress(f"interleaving of three cameras: {name} depth, order {order_name}")
            found.append(fuse_in_order(device, placed, order, noise))
        spread, seen, error = _spread(found, true)
        figures[f"{name}_median_spread_voxels"] = float(np.median(spread))
        figures[f"{name}_99_percent_spread_voxels"] = float(np.quantile(spread, 0.99))
        figures[f"{name}_far_apart"] = float((spread > 1).mean())
        figures[f"{name}_seen_by_all_orders"] = seen
        figures[f"{name}_median_error_voxels"] = error
    progress("interleaving of three cameras: one of them 2 cm off")
    return {**figures, **_offset_figures(device, pictures)}


def _offset_figures(device: Device, pictures: int) -> dict[str, float]:
    order = orders(pictures)["ABCABC"]
    right = fuse_in_order(device, stations(), order, NOISE)[0]
    wrong = fuse_in_order(device, stations(offset_m=0.02), order, NOISE)[0]
    both = (right > 0) & (wrong > 0)
    moved = np.abs(right - wrong)[both] / VOXEL_M
    return {
        "offset_median_moved_voxels": float(np.median(moved)),
        "offset_99_percent_moved_voxels": float(np.quantile(moved, 0.99)),
        "offset_lost": float(((right > 0) & (wrong == 0)).mean()),
    }


def _spread(found: list[list[Floats]], true: list[Floats]) -> tuple[Floats, float, float]:
    """Greatest less least depth over the orders, voxels; share seen by all of that seen by any; median error."""
    spreads, alls, anys, errors = [], 0, 0, []
    for camera, truth in enumerate(true):
        depths = np.stack([order[camera] for order in found])
        seen = (depths > 0).all(0)
        spreads.append(np.ptp(depths, axis=0)[seen] / VOXEL_M)
        errors.append(np.abs(depths - truth)[:, seen].ravel() / VOXEL_M)
        alls, anys = alls + int(seen.sum()), anys + int((depths > 0).any(0).sum())
    return np.concatenate(spreads), alls / anys, float(np.median(np.concatenate(errors)))


def _frame(number: int, station: Station, depth_m: Floats) -> RgbdFrame:
    units = np.clip(np.rint(depth_m / station.camera.depth_scale_m), 0, 65534).astype(np.uint16)
    color = np.full((*units.shape, 3), 128, np.uint8)
    return RgbdFrame(number, number / 30, color, units, station.world_from_camera)
