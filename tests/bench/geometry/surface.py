"""How far a predicted surface lies from the exact one, as depth pictures from one view."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from protocol.frames import CameraModel, RgbdFrame
from protocol.messages import Wishes
from server.geometry.geometry import Geometry, GeometryFrame
from server.opencl.device import Device
from server.opencl.engine import Engine
from server.volume.bounds import Bounds


@dataclass(frozen=True)
class SurfaceAccuracy:
    """Over all pixels whose exact point lies inside the volume."""

    median_voxels: float
    """Of the absolute difference in depth, along the optical axis; infinite without any surface."""
    p90_voxels: float
    bias_voxels: float
    """Median of the signed difference; positive behind the exact surface."""
    covered: float
    """Share of the pixels that have surface."""


@dataclass(frozen=True)
class SurfaceView:
    """One view: depth pictures [h, w] float, metres, 0 = none."""

    depth_m: NDArray[np.floating]
    exact_m: NDArray[np.floating]
    inside: NDArray[np.bool_]
    """[h, w] pixels that count; exact_m is positive there."""


def surface_accuracy(views: Iterable[SurfaceView], voxel_m: float) -> SurfaceAccuracy:
    """All views together. Raises ValueError where no pixel counts."""
    off, total = [np.empty(0)], 0
    for view in views:
        found = view.inside & (view.depth_m > 0)
        off.append((view.depth_m[found].astype(np.float64) - view.exact_m[found]) / voxel_m)
        total += int(view.inside.sum())
    if not total:
        raise ValueError("no pixel of the exact depth lies inside the volume")
    error = np.concatenate(off)
    if not error.size:
        return SurfaceAccuracy(np.inf, np.inf, np.inf, 0.0)
    median, p90 = np.percentile(np.abs(error), (50, 90))
    return SurfaceAccuracy(float(median), float(p90), float(np.median(error)), error.size / total)


def inside_bounds(
    camera: CameraModel,
    world_from_camera: NDArray[np.float64],
    exact_m: NDArray[np.floating],
    bounds_m: Bounds,
    margin_m: float,
) -> NDArray[np.bool_]:
    """[h, w] whether the exact depth's point lies in the box, `margin_m` and more from its sides."""
    y, x = np.indices(exact_m.shape)
    rays = np.stack([(x - camera.cx) / camera.fx, (y - camera.cy) / camera.fy, np.ones(exact_m.shape)], axis=-1)
    points = (rays * exact_m[..., None]) @ world_from_camera[:3, :3].T + world_from_camera[:3, 3]
    low, high = np.array(bounds_m[:3]) + margin_m, np.array(bounds_m[3:]) - margin_m
    inside: NDArray[np.bool_] = (exact_m > 0) & ((points >= low) & (points <= high)).all(axis=-1)
    return inside


def fused_views(
    device: Device,
    camera: CameraModel,
    frames: Iterable[tuple[RgbdFrame, NDArray[np.floating] | None]],
    bounds_m: Bounds,
    voxel_m: float,
) -> list[SurfaceView]:
    """Fuse frames at their given poses; the volume's surface at each that comes with its exact depth [h, w] in metres.

    The surface is the volume's alone, without what the sensor adds; a voxel from the box's sides it does not count.
    """
    engine = Engine(device)
    geometry = Geometry(engine, camera, Wishes(volume_m=bounds_m, voxel_m=voxel_m))
    views = []
    try:
        for frame, exact_m in frames:
            result = geometry.scan(frame)
            if exact_m is not None:
                inside = inside_bounds(camera, result.world_from_camera, exact_m, bounds_m, voxel_m)
                views.append(SurfaceView(model_depth(engine, result), exact_m, inside))
    finally:
        engine.close()
    return views


def model_depth(engine: Engine, geometry: GeometryFrame) -> NDArray[np.float32]:
    """The volume's surface as depth [h, w] along the camera's axis in metres, 0 = none."""
    positions = geometry.model.positions
    points = engine.download(positions).view(np.float32).reshape(*positions.shape, 4)
    pose = geometry.volume_from_camera
    depth = (points[..., :3] - pose[:3, 3]) @ pose[:3, 2]
    return np.where(points[..., 3] == 1, depth, 0).astype(np.float32)
