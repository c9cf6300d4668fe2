"""By how much the depth filters of thesis 5.1.1 improve the normals of measured depth, against the truth."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass

import cv2
import numpy as np
import pyopencl.array as cl_array
from numpy.typing import NDArray

from protocol.frames import CameraModel
from server.input.denoise import bilateral_depth
from server.opencl.device import Device
from server.opencl.engine import Engine
from tests.scenes.tv_l1_depth import tv_l1_depth

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]

_REACH_PX = 2
_PLANE_PX = 4
_PLANE_RMS_M = 0.0008


@dataclass(frozen=True)
class NormalView:
    """One measured depth picture and its truth, [h, w], camera axes."""

    depth_m: NDArray[np.floating]
    """Measured, metres, 0 = none."""
    normals: NDArray[np.floating]
    """[h, w, 3] exact, unit, towards the camera."""
    known: Bools
    """[h, w] where `normals` hold."""


@dataclass(frozen=True)
class NormalError:
    """Angle between measured and exact normals in degrees."""

    median_deg: float
    mean_deg: float


@dataclass(frozen=True)
class NormalImprovement:
    """The same pixels without a filter and with each."""

    raw: NormalError
    bilateral: NormalError
    tv_l1: NormalError


def normal_improvement(device: Device, camera: CameraModel, views: Iterable[NormalView]) -> NormalImprovement:
    """All views together, each over the pixels that have a normal without a filter too.

    Raises ValueError where there is none.
    """
    engine = Engine(device)
    filters: tuple[Callable[[Engine, cl_array.Array], cl_array.Array], ...] = (
        lambda _, depth_m: depth_m,
        bilateral_depth,
        tv_l1_depth,
    )
    angles: tuple[list[Floats], ...] = ([], [], [])
    try:
        for view in views:
            depth_m = engine.workspace.upload("measured_depth_m", view.depth_m.astype(np.float32))
            found = [depth_normals(camera, engine.download(smooth(engine, depth_m))) for smooth in filters]
            counts = view.known & np.all([normals.any(-1) for normals in found], axis=0)
            for kind, normals in zip(angles, found, strict=True):
                cosine = (normals[counts] * view.normals[counts]).sum(-1)
                kind.append(np.degrees(np.arccos(np.clip(cosine, -1, 1))))
    finally:
        engine.close()
    return NormalImprovement(*(_error(np.concatenate([np.empty(0), *kind])) for kind in angles))


def _error(angles_deg: Floats) -> NormalError:
    if not angles_deg.size:
        raise ValueError("no pixel has a measured and an exact normal")
    return NormalError(float(np.median(angles_deg)), float(angles_deg.mean()))


def depth_normals(camera: CameraModel, depth_m: NDArray[np.floating]) -> Floats:
    """[h, w, 3] unit, camera axes, towards the camera, 0 = none: by differences two pixels to either side.

    As the geometry buffer takes them (merge.cl): of neighbours on the same surface, else one-sided.
    """
    v, u = np.indices(depth_m.shape)
    rays = np.stack([(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, np.ones(depth_m.shape)], axis=-1)
    points = depth_m[..., None] * rays
    along_x = _neighbour(camera, points, 0, _REACH_PX) - _neighbour(camera, points, 0, -_REACH_PX)
    along_y = _neighbour(camera, points, _REACH_PX, 0) - _neighbour(camera, points, -_REACH_PX, 0)
    normals = np.cross(along_y, along_x)
    length = np.linalg.norm(normals, axis=-1, keepdims=True)
    return np.where((length > 1e-12) & (depth_m > 0)[..., None], normals / np.where(length > 0, length, 1), 0)


def _neighbour(camera: CameraModel, points: Floats, dy: int, dx: int) -> Floats:
    """The point `dy`, `dx` pixels on where it is of the same surface, else the pixel's own."""
    height, width = points.shape[:2]
    v, u = np.indices((height, width))
    inside = (v + dy >= 0) & (v + dy < height) & (u + dx >= 0) & (u + dx < width)
    other = points[np.clip(v + dy, 0, height - 1), np.clip(u + dx, 0, width - 1)]
    edge_m = max(0.02, 3 * _REACH_PX / camera.fx) * points[..., 2] + 0.005
    same = inside & (other[..., 2] > 0) & (np.abs(other[..., 2] - points[..., 2]) < edge_m)
    return np.where(same[..., None], other, points)


def plane_normals(camera: CameraModel, exact_m: NDArray[np.floating]) -> tuple[Floats, Bools]:
    """Normals [h, w, 3] of exact depth [h, w] in metres, 0 = none, and where they are known.

    By a plane through 9 x 9 pixels, whose inverse depth is linear in the picture: truth for depth in whole millimetres,
    whose differences are not. Known where the plane fits to 0.8 mm (RMS): not at edges, creases and tight curves.
    """
    v, u = np.indices(exact_m.shape).astype(np.float64)
    inverse = np.divide(1.0, exact_m, out=np.zeros(exact_m.shape), where=exact_m > 0)
    mean = _mean(inverse)
    variance = ((2 * _PLANE_PX + 1) ** 2 - 1) / 12  # of a pixel's column in the window
    slope_u = (_mean(inverse * (u - camera.cx)) - mean * (u - camera.cx)) / variance
    slope_v = (_mean(inverse * (v - camera.cy)) - mean * (v - camera.cy)) / variance
    scatter = _mean(inverse**2) - mean**2 - (slope_u**2 + slope_v**2) * variance
    x, y = (u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy
    slope_x, slope_y = slope_u * camera.fx, slope_v * camera.fy
    normals = -np.stack([slope_x, slope_y, mean - slope_x * x - slope_y * y], axis=-1)
    length = np.linalg.norm(normals, axis=-1, keepdims=True)
    fits = np.sqrt(np.maximum(scatter, 0)) * exact_m**2 < _PLANE_RMS_M
    whole = cv2.erode((exact_m > 0).astype(np.uint8), np.ones((2 * _PLANE_PX + 1,) * 2), borderValue=0) > 0
    return normals / np.where(length > 0, length, 1), fits & whole


def _mean(values: Floats) -> Floats:
    side = 2 * _PLANE_PX + 1
    result: Floats = cv2.blur(values, (side, side)).astype(np.float64)
    return result
