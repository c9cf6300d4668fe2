"""Float64 twin of cl_kernels/merge.cl and geometry_buffer.cl: the hybrid geometry buffer (thesis 4.2.2, eq. 4.1-4.5).

Depth pictures are [h, w] metres along the optical axis, 0 = unknown. The median of an even count is the lower one.
"""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray

from protocol.frames import CameraModel

NONE, STATIC, DYNAMIC, FILLED = 0, 1, 2, 3
HOLE_OFFSETS = [(dx, dy) for dy in range(-8, 9, 4) for dx in range(-8, 9, 4)]
"""Omega_k of eq. 4.3: 17 x 17 pixels, subsampled to 5 x 5."""
LEAST_SUPPORT = 4
ALIGN_OFFSETS = [(dx, dy) for dy in range(-2, 3) for dx in range(-2, 3)]
SMOOTH_OFFSETS = [(dx, dy) for dy in range(-1, 2) for dx in range(-1, 2)]
LAMBDA_INTENSITY = 0.04
NORMAL_STEPS = [(i, j) for j in range(-2, 3) for i in range(-2, 3)]
RIDGE = 0.5
LUMINANCE = np.array([0.2126, 0.7152, 0.0722])

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]
Offsets = Iterable[tuple[int, int]]


def agreement_m(depth_m: Floats, voxel_m: float) -> Floats:
    """lambda_D: 1.5 voxels and four deviations of the sensor's axial noise (Nguyen et al. 2012, eq. 3), metres."""
    return 1.5 * voxel_m + 4 * (0.0012 + 0.0019 * (depth_m - 0.4) ** 2)


def agreement(sensor_m: Floats, volume_m: Floats, voxel_m: float) -> Bools:
    """[h, w] whether sensor and volume agree: to lambda_D; on the mean over 5 x 5 pixels that do so, by much less."""
    apart = sensor_m - volume_m
    close = (sensor_m > 0) & (volume_m > 0) & (np.abs(apart) < agreement_m(sensor_m, voxel_m))
    count = np.maximum(around(close, ALIGN_OFFSETS).sum(axis=0), 1)
    mean = around(np.where(close, apart, 0), ALIGN_OFFSETS).sum(axis=0) / count
    return close & (np.abs(mean) < voxel_m + 0.8 * (0.0012 + 0.0019 * (sensor_m - 0.4) ** 2))


def same_surface_m(depth_m: Floats) -> Floats:
    """Greatest difference of neighbouring depths of one surface, metres."""
    return 0.02 * depth_m + 0.005


def unmixed(sensor_m: Floats) -> Floats:
    """[h, w] depth without pixels that mix two surfaces: at most two neighbours alike, others nearer and farther."""
    depths, near = around(sensor_m, SMOOTH_OFFSETS), same_surface_m(sensor_m)
    known = depths > 0
    own = (known & (np.abs(depths - sensor_m) < near)).sum(axis=0)
    nearer, farther = known & (depths <= sensor_m - near), known & (depths >= sensor_m + near)
    return np.where((own <= 3) & nearer.any(axis=0) & farther.any(axis=0), 0, sensor_m)


def intensity(radiance: Floats) -> Floats:
    """[h, w] square root of the luminance: equal noise at every brightness. radiance [h, w, 3] linear."""
    return np.sqrt(np.maximum(radiance @ LUMINANCE, 0))


def around(picture: NDArray, offsets: Offsets) -> NDArray:
    """[n, h, w] the picture's values at every pixel plus each offset (dx, dy); 0 (False) outside."""
    height, width = picture.shape
    padded = np.pad(picture, 16)
    return np.stack([padded[16 + dy : 16 + dy + height, 16 + dx : 16 + dx + width] for dx, dy in offsets])


def lower_median(values: Floats, chosen: Bools) -> Floats:
    """[h, w] of values [n, h, w] where `chosen`; 0 where none is."""
    ordered = np.sort(np.where(chosen, values, np.inf), axis=0)
    count = chosen.sum(axis=0)
    middle = np.take_along_axis(ordered, np.maximum(count - 1, 0)[None] // 2, axis=0)[0]
    return np.where(count > 0, middle, 0)


def similar(shade: Floats, offsets: Offsets) -> Bools:
    """Eq. 4.1: [n, h, w] whether the neighbour has a similar intensity."""
    return np.abs(around(shade, offsets) - shade) < LAMBDA_INTENSITY


def merge(sensor_m: Floats, volume_m: Floats, agrees: Bools, trusted: Bools, shade: Floats, voxel_m: float) -> Floats:
    """D' (eq. 4.1-4.3): the volume where both agree, else the sensor; holes by a vote of the neighbours.

    agrees: see agreement; trusted: [h, w] whether the volume has seen its surface for long. In a hole it has no word if
    not, or if the sensor sees through most of that surface within the window. Without any word and enough support the
    hole stays.
    """
    measured, agreeing = around(sensor_m, HOLE_OFFSETS), around(agrees, HOLE_OFFSETS)
    offsets = [*HOLE_OFFSETS, *((dx // 2, dy // 2) for dx, dy in HOLE_OFFSETS)]
    same = np.abs(around(volume_m, offsets) - volume_m) < agreement_m(volume_m, voxel_m)
    same &= around(sensor_m, offsets) > 0
    still, gone = around(agrees, offsets), around(~agrees & (sensor_m > volume_m), offsets)
    has_word = trusted & (volume_m > 0) & ((same & still).sum(axis=0) >= (same & gone).sum(axis=0))
    support = similar(shade, HOLE_OFFSETS) & (measured > 0)
    count, votes = support.sum(axis=0), (support & agreeing).sum(axis=0)
    by_support = (count >= LEAST_SUPPORT) & ((2 * votes < count) | ~has_word)
    filled = np.where(by_support, lower_median(measured, support), np.where(has_word, volume_m, 0))
    return np.where(sensor_m > 0, np.where(agrees, volume_m, sensor_m), filled)


def has_others(depth_m: Floats, volume_m: Floats, offsets: Offsets) -> Bools:
    """[h, w] whether any depth of the window is known and not the volume's."""
    return around((depth_m > 0) & (depth_m != volume_m), offsets).any(axis=0)


def align(merged_m: Floats, volume_m: Floats, shade: Floats) -> Floats:
    """D'' (eq. 4.4): joint bilateral median; unknown depth and windows of the volume's depth are unchanged."""
    depths = around(merged_m, ALIGN_OFFSETS)
    aligned = lower_median(depths, similar(shade, ALIGN_OFFSETS) & (depths > 0))
    return np.where((merged_m > 0) & has_others(merged_m, volume_m, ALIGN_OFFSETS), aligned, merged_m)


def smooth(aligned_m: Floats, volume_m: Floats) -> Floats:
    """D''' (eq. 4.5): median, of the pixel's own surface if it has two neighbours; else as align."""
    depths = around(aligned_m, SMOOTH_OFFSETS)
    known = depths > 0
    own = known & (np.abs(depths - aligned_m) < same_surface_m(aligned_m))
    median = lower_median(depths, np.where(own.sum(axis=0) >= 3, own, known))
    return np.where((aligned_m > 0) & has_others(aligned_m, volume_m, SMOOTH_OFFSETS), median, aligned_m)


def label(depth_m: Floats, sensor_m: Floats, volume_m: Floats, agrees: Bools, voxel_m: float) -> NDArray[np.int64]:
    """[h, w] labels: static if the depth is the volume's, else dynamic if it is the sensor's, else filled."""
    near = agreement_m(depth_m, voxel_m)
    has_shifted = (sensor_m > 0) & ~agrees & (np.abs(sensor_m - volume_m) < near)
    of_volume = (volume_m > 0) & (np.abs(depth_m - volume_m) < near) & ~has_shifted
    of_sensor = (sensor_m > 0) & (np.abs(depth_m - sensor_m) < near)
    known = np.where(of_volume, STATIC, np.where(of_sensor, DYNAMIC, FILLED))
    return np.where(depth_m > 0, known, NONE)


def fit_normals(camera: CameraModel, depth_m: Floats) -> Floats:
    """[h, w, 3] unit, camera space, towards the camera; 0 where under three neighbours lie on the same surface.

    A plane's inverse depth is linear in the pixel: its slopes by least squares over 5 x 5 pixels, two apart.
    """
    here = np.where(depth_m > 0, depth_m, 1)
    near = np.maximum(0.02, 12 / camera.fx) * here + 0.005
    total, moments = np.zeros((1, *depth_m.shape)), np.zeros((8, *depth_m.shape))
    for i, j in NORMAL_STEPS:
        there = around(depth_m, [(2 * i, 2 * j)])[0]
        used = (there > 0) & (depth_m > 0) & (np.abs(there - here) < near)
        r = here / np.where(there > 0, there, 1) - 1
        total += used
        moments += used * np.stack(np.broadcast_arrays(i, j, i * i, i * j, j * j, r, i * r, j * r))
    n = np.maximum(total[0], 1)
    i, j, ii, ij, jj, r, ir, jr = moments
    uu, uv, vv = ii - i * i / n + RIDGE, ij - i * j / n, jj - j * j / n + RIDGE
    ur, vr = ir - i * r / n, jr - j * r / n
    scale = 1 / (2 * (uu * vv - uv * uv))  # two pixels a step
    a, b = scale * (ur * vv - vr * uv), scale * (vr * uu - ur * uv)
    v, u = np.mgrid[: camera.height, : camera.width]
    normals = -np.stack([a * camera.fx, b * camera.fy, 1 - a * (u - camera.cx) - b * (v - camera.cy)], axis=-1)
    normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
    return np.where(total[0][..., None] >= 3, normals, 0)


def merge_depth(
    camera: CameraModel,
    volume_from_camera: Floats,
    depth_m: Floats,
    radiance: Floats,
    voxel_m: float,
    positions: Floats,
    normals: Floats,
    trusted: Bools,
    still: Bools,
) -> tuple[Floats, Floats, NDArray[np.int64]]:
    """positions, normals [h, w, 4] (w = 1 where valid) and labels [h, w] of the merged buffer.

    positions, normals: the volume's surface; depth_m: measured; radiance [h, w, 3] linear; trusted: see merge; still:
    [h, w] whether the volume has seen its surface long enough to call it static.
    """
    rotation, origin = volume_from_camera[:3, :3], volume_from_camera[:3, 3]
    volume_m = np.where(positions[..., 3] > 0, (positions[..., :3] - origin) @ rotation[:, 2], 0)
    shade, agrees = intensity(radiance), agreement(depth_m, volume_m, voxel_m) & still
    depth_m = unmixed(depth_m)
    merged_m = merge(depth_m, volume_m, agrees, trusted, shade, voxel_m)
    filtered = smooth(align(merged_m, volume_m, shade), volume_m)
    labels = label(filtered, depth_m, volume_m, agrees, voxel_m)
    v, u = np.mgrid[: camera.height, : camera.width]
    rays = np.stack([(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, np.ones_like(u, float)], axis=-1)
    points = filtered[..., None] * rays @ rotation.T + origin
    facing = fit_normals(camera, filtered)
    seen = [
        np.concatenate([points, (filtered > 0)[..., None]], axis=-1),
        np.concatenate([facing @ rotation.T, facing.any(axis=-1, keepdims=True)], axis=-1),
    ]
    merged = [
        np.where((labels == STATIC)[..., None], old, np.where((labels == NONE)[..., None], 0, new))
        for old, new in zip((positions, normals), seen, strict=True)
    ]
    return merged[0], merged[1], labels
