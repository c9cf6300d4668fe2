"""Float64 twin of cl_kernels/integrate.cl: TSDF fusion (Newcombe et al. 2011, eq. 6-13; thesis 4.2.1), on a dense grid."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from protocol.frames import CameraModel

Floats = NDArray[np.float64]


def voxel_centers(shape: tuple[int, ...], voxel_m: float) -> Floats:
    """[z, y, x, 3] centres (x, y, z) in volume space, metres."""
    z, y, x = np.mgrid[: shape[0], : shape[1], : shape[2]]
    return (np.stack([x, y, z], axis=-1) + 0.5) * voxel_m


def project(camera: CameraModel, points: Floats) -> Floats:
    """[..., 2] pixel coordinates of points [..., 3] in camera space; infinite behind the camera."""
    with np.errstate(divide="ignore", invalid="ignore"):
        pixels = points[..., :2] / points[..., 2:] * (camera.fx, camera.fy) + (camera.cx, camera.cy)
    return np.where(points[..., 2:] > 0, pixels, np.inf)


def signed_distance(camera: CameraModel, points: Floats, depth_m: Floats) -> Floats:
    """[...] distance along the ray from points [..., 3] (camera space) to what their nearest pixel measured, metres.

    Positive in front; NaN where the pixel is outside the picture or measured nothing.
    """
    pixels = project(camera, points) + 0.5
    seen = ((pixels >= 0) & (pixels < (camera.width, camera.height))).all(-1)
    u, v = np.where(seen[..., None], pixels, 0).astype(int).transpose(-1, *range(pixels.ndim - 1))
    depth = depth_m[v, u]
    with np.errstate(divide="ignore", invalid="ignore"):
        distance = (depth - points[..., 2]) * np.linalg.norm(points, axis=-1) / points[..., 2]
    return np.where(seen & (depth > 0), distance, np.nan)


def integrate(
    camera: CameraModel,
    volume_from_camera: Floats,
    depth_m: Floats,
    voxel_m: float,
    truncation_m: float,
    greatest_weight: float,
    tsdf: Floats,
    weight: Floats,
) -> tuple[Floats, Floats]:
    """tsdf (in truncations) and weight, [z, y, x], after one more depth picture: a running mean with equal weights."""
    centers = voxel_centers(tsdf.shape, voxel_m)
    points = (centers - volume_from_camera[:3, 3]) @ volume_from_camera[:3, :3]
    distance = signed_distance(camera, points, depth_m)
    updated = distance > -truncation_m
    sample = np.minimum(distance / truncation_m, 1)
    mean = (weight * tsdf + sample) / (weight + 1)
    return np.where(updated, mean, tsdf), np.where(updated, np.minimum(weight + 1, greatest_weight), weight)
