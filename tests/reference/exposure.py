"""Float64 twin of cl_kernels/exposure.cl, dense: the brightness of surface seen before, and seen again."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from protocol.frames import CameraModel

Floats = NDArray[np.float64]

LUMINANCE = np.array([0.2126, 0.7152, 0.0722])
MOST_UNEVEN, LEAST_COSINE, LEAST_COLORED = 0.25, 0.3, 0.5
LEAST_PREDICTED, MOST_PREDICTED = 0.002, 0.9
CLIPPED_MARK = -0.5


def agreement_m(depth_m: float, voxel_m: float) -> float:
    """1.5 voxels and four deviations of the noise along z (Nguyen et al. 2012, eq. 3)."""
    return 1.5 * voxel_m + 4 * (0.0012 + 0.0019 * (depth_m - 0.4) ** 2)


def even_luminance(radiance: Floats, x: int, y: int) -> float:
    """Mean luminance of 3 x 3 pixels of radiance [h, w, 4]; 0 where it is not to be used."""
    height, width = radiance.shape[:2]
    if not (1 <= x < width - 1 and 1 <= y < height - 1):
        return 0.0
    patch = radiance[y - 1 : y + 2, x - 1 : x + 2]
    luminance = patch[..., :3] @ LUMINANCE
    even = np.ptp(luminance) <= MOST_UNEVEN * luminance.mean()
    return float(luminance.mean()) if even and (patch[..., 3] > 0).all() else 0.0


class DenseVolume:
    """Voxels of a whole volume, [z, y, x]; outside it nothing was seen."""

    def __init__(self, voxel_m: float, tsdf: Floats, weight: Floats, color: Floats, observations: Floats) -> None:
        self.voxel_m = voxel_m
        self.tsdf, self.weight, self.color, self.observations = tsdf, weight, color, observations

    def cell(self, point: Floats) -> tuple[tuple[NDArray[np.int64], ...], Floats, Floats]:
        """Indices of the eight voxels around a point (metres), their weights, and the weights' slopes [8, 3]."""
        at = point / self.voxel_m - 0.5
        corners = np.array(list(np.ndindex(2, 2, 2)))
        base, fraction = np.floor(at).astype(int), at - np.floor(at)
        factors = np.where(corners == 1, fraction, 1 - fraction)
        signs = np.where(corners == 1, 1.0, -1.0)
        slopes = np.stack([signs[:, a] * np.delete(factors, a, axis=1).prod(1) for a in range(3)], axis=1)
        x, y, z = (base + corners).T
        return (z, y, x), factors.prod(1), slopes

    def is_known(self, indices: tuple[NDArray[np.int64], ...], least_weight: float) -> bool:
        """Whether all voxels exist and were seen often enough."""
        exist = all(((i >= 0) & (i < n)).all() for i, n in zip(indices, self.tsdf.shape, strict=True))
        return bool(exist and (self.weight[indices] >= least_weight).all())


def surface_point(
    camera: CameraModel,
    volume_from_camera: Floats,
    volume: DenseVolume,
    truncation_m: float,
    least_weight: float,
    pixel: tuple[int, int],
    depth_m: float,
) -> Floats | None:
    """Where the volume has the surface that a pixel (x, y) measured; None where it has none there, or a grazed one."""
    ray = np.array([(pixel[0] - camera.cx) / camera.fx, (pixel[1] - camera.cy) / camera.fy, 1.0])
    turned = volume_from_camera[:3, :3] @ ray
    direction = turned / np.linalg.norm(turned)
    point = volume_from_camera[:3, :3] @ (depth_m * ray) + volume_from_camera[:3, 3]
    indices, weights, slopes = volume.cell(point)
    if not volume.is_known(indices, least_weight):
        return None
    off_m = float(weights @ volume.tsdf[indices]) * truncation_m
    normal = volume.tsdf[indices] @ slopes
    grazed = -normal @ direction <= LEAST_COSINE * np.linalg.norm(normal)
    far = abs(off_m) >= min(agreement_m(depth_m, volume.voxel_m), 0.9 * truncation_m)
    return None if grazed or far else point + off_m * direction


def prediction(volume: DenseVolume, point: Floats, least_weight: float) -> tuple[float, float] | None:
    """Luminance of the volume at a point, and number of observations; None where it is not reliable."""
    indices, weights, _ = volume.cell(point)
    if not volume.is_known(indices, least_weight):
        return None
    colored = weights * (volume.observations[indices] > 0)
    if colored.sum() < LEAST_COLORED or volume.color[indices].max() >= MOST_PREDICTED:
        return None
    luminance = float(colored @ (volume.color[indices] @ LUMINANCE) / colored.sum())
    return (
        (luminance, float(colored @ volume.observations[indices] / colored.sum()))
        if luminance > LEAST_PREDICTED
        else None
    )


def compare_exposure(
    camera: CameraModel,
    volume_from_camera: Floats,
    radiance: Floats,
    depth_m: Floats,
    volume: DenseVolume,
    truncation_m: float,
    least_weight: float,
    stride: int,
) -> Floats:
    """[rows, cols, 3] (seen, predicted, observations) at the middle pixel of each block. radiance: [h, w, 4]."""
    rows, cols = camera.height // stride, camera.width // stride
    result = np.zeros((rows, cols, 3))
    for row, col in np.ndindex(rows, cols):
        x, y = col * stride + stride // 2, row * stride + stride // 2
        seen, depth = even_luminance(radiance, x, y), float(depth_m[y, x])
        if seen <= 0 or depth <= 0:
            continue
        where = surface_point(camera, volume_from_camera, volume, truncation_m, least_weight, (x, y), depth)
        known = None if where is None else prediction(volume, where, least_weight)
        if known is not None:
            result[row, col] = (seen, *known)
    return result


def scale_radiance(radiance: Floats, factor: float) -> Floats:
    """[..., 4] in other units; what was clipped is marked as the least that it can be."""
    clipped = (radiance[..., 3] == 0) & (radiance[..., :3].max(-1) > 0.5)
    mark = np.where(clipped, CLIPPED_MARK, radiance[..., 3])
    return np.concatenate([factor * radiance[..., :3], mark[..., None]], axis=-1)
