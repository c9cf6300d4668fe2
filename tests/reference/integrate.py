"""Float64 twin of cl_kernels/integrate.cl, dense: TSDF fusion (Newcombe et al. 2011, eq. 6-13; thesis 4.2.1)."""

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


def depth_at(pixels: Floats, depth_m: Floats, edge_m: float) -> Floats:
    """[...] measured depth at pixels [..., 2] inside the picture, 0 = none.

    Bilinear where the four pixels around all measured something and differ by less than `edge_m`; else the nearest.
    """
    height, width = depth_m.shape
    u, v = np.floor(pixels + 0.5).astype(int).transpose(-1, *range(pixels.ndim - 1))
    low = np.clip(np.floor(pixels), 0, (width - 2, height - 2)).astype(int)
    share = np.clip(pixels - low, 0, 1)
    corners, weights = [], []
    for dx, dy in ((0, 0), (1, 0), (0, 1), (1, 1)):
        corners.append(depth_m[low[..., 1] + dy, low[..., 0] + dx])
        across, down = (share[..., axis] if there else 1 - share[..., axis] for axis, there in enumerate((dx, dy)))
        weights.append(across * down)
    one_surface = (np.min(corners, axis=0) > 0) & (np.ptp(corners, axis=0) < edge_m)
    return np.where(one_surface, (np.array(corners) * weights).sum(0), depth_m[v, u])


def signed_distance(camera: CameraModel, points: Floats, depth_m: Floats, edge_m: float) -> Floats:
    """[...] distance along the ray from points [..., 3] (camera space) to the surface measured there, metres.

    Positive in front; NaN where the point's nearest pixel is outside the picture or measured nothing.
    """
    pixels = project(camera, points)
    seen = ((pixels >= -0.5) & (pixels < (camera.width - 0.5, camera.height - 0.5))).all(-1)
    depth = np.zeros(seen.shape)
    depth[seen] = depth_at(pixels[seen], depth_m, edge_m)
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
    """tsdf (in truncations) and weight, [z, y, x], after one more depth picture: a running mean with equal weights.

    Pixels that differ by the truncation or more are taken as different surfaces.
    """
    centers = voxel_centers(tsdf.shape, voxel_m)
    points = (centers - volume_from_camera[:3, 3]) @ volume_from_camera[:3, :3]
    distance = signed_distance(camera, points, depth_m, truncation_m)
    updated = distance > -truncation_m
    sample = np.minimum(distance / truncation_m, 1)
    mean = (weight * tsdf + sample) / (weight + 1)
    return np.where(updated, mean, tsdf), np.where(updated, np.minimum(weight + 1, greatest_weight), weight)


def integrate_color(
    camera: CameraModel,
    volume_from_camera: Floats,
    depth_m: Floats,
    radiance: Floats,
    voxel_m: float,
    truncation_m: float,
    color: Floats,
    count: Floats,
) -> tuple[Floats, Floats]:
    """Linear RGB [z, y, x, 3] and its weight [z, y, x] after one more picture: a running mean, the weight at most 62.

    A voxel within 1.5 voxels of the measured surface takes the colour of its nearest pixel. radiance: [h, w, 3].
    """
    points = (voxel_centers(count.shape, voxel_m) - volume_from_camera[:3, 3]) @ volume_from_camera[:3, :3]
    near = np.abs(signed_distance(camera, points, depth_m, truncation_m)) < 1.5 * voxel_m  # NaN is not near
    pixels = np.where(near[..., None], project(camera, points), 0)
    u, v = np.floor(pixels + 0.5).astype(int).transpose(-1, 0, 1, 2)
    next_count = np.minimum(count + 1, 62)
    mean = color + (np.minimum(radiance[v, u], 1) - color) / next_count[..., None]
    return np.where(near[..., None], mean, color), np.where(near, next_count, count)
