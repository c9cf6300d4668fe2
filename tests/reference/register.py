"""Float64 twin of cl_kernels/register.cl: registers depth to another lens, by triangles between neighbouring pixels.

For each colour pixel, the nearest triangle over it; a measured point only where no triangle is near it or in front.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from protocol.frames import CameraModel

Floats = NDArray[np.float64]
NO_MEASUREMENT = 65535
LEAST_Z_M = 0.01


def same_surface_m(z: Floats | float, focal_px: float) -> Floats:
    """Greatest difference of neighbouring depths of one surface."""
    return np.asarray(max(0.02, 3 / focal_px) * z + 0.005)


def project_depth(camera: CameraModel, rays: Floats, depth: NDArray[np.uint16], greatest_m: float) -> Floats:
    """[h, w, 4]: pixel in the colour picture, 1 / z there, z here; 0 = none. rays [h, w, 3]: (x, y, 1 where valid)."""
    z = np.where(depth == NO_MEASUREMENT, 0, depth * camera.depth_scale_m)
    to_color = camera.color_from_depth
    points = (z[..., None] * np.stack([rays[..., 0], rays[..., 1], np.ones_like(z)], -1)) @ to_color[:3, :3].T
    points = points + to_color[:3, 3]
    usable = (z > 0) & (z <= greatest_m) & (rays[..., 2] > 0) & (points[..., 2] > LEAST_Z_M)
    there = np.where(usable, points[..., 2], 1)
    u = camera.fx * points[..., 0] / there + camera.cx
    v = camera.fy * points[..., 1] / there + camera.cy
    return np.where(usable[..., None], np.stack([u, v, 1 / there, z], -1), 0)


def is_surface(corners: tuple[Floats, Floats, Floats], focal_px: float) -> bool:
    """Whether three projected neighbours are measured and of one surface."""
    depths = [float(corner[3]) for corner in corners]
    return min(depths) > 0 and max(depths) - min(depths) < same_surface_m(min(depths), focal_px)


def triangles(projected: Floats, focal_px: float) -> Iterator[tuple[Floats, Floats, Floats]]:
    """Surface triangles of every square of neighbours, for the diagonal that gives more of them."""
    for y in range(projected.shape[0] - 1):
        for x in range(projected.shape[1] - 1):
            a, b, c, d = projected[y, x], projected[y, x + 1], projected[y + 1, x], projected[y + 1, x + 1]
            cuts = ((a, b, d), (a, d, c)), ((a, b, c), (b, d, c))
            yield from max(([t for t in cut if is_surface(t, focal_px)] for cut in cuts), key=len)


def cover(size: tuple[int, int], corners: tuple[Floats, Floats, Floats], greatest_px: int) -> Floats:
    """[h, w] depth of a triangle at the pixel centres in it, infinite elsewhere, and if turned away or too large."""
    height, width = size
    v, u = np.mgrid[:height, :width].astype(np.float64)
    pixels = np.array([corner[:2] for corner in corners])
    (x0, y0), (x1, y1), (x2, y2) = pixels
    whole = (x1 - x0) * (y2 - y0) - (y1 - y0) * (x2 - x0)
    if whole <= 0 or (pixels.max(0) - pixels.min(0)).max() > greatest_px:
        return np.full(size, np.inf)
    share_1 = ((u - x0) * (y2 - y0) - (v - y0) * (x2 - x0)) / whole
    share_2 = ((x1 - x0) * (v - y0) - (y1 - y0) * (u - x0)) / whole
    shares = np.stack([1 - share_1 - share_2, share_1, share_2])
    inverse_z = np.tensordot([corner[2] for corner in corners], shares, 1)
    inside = (shares >= 0).all(0)
    return np.where(inside, 1 / np.where(inside, inverse_z, 1), np.inf)


def register_depth(
    camera: CameraModel, rays: Floats, depth: NDArray[np.uint16], greatest_m: float, greatest_px: int
) -> Floats:
    """[h, w] metres in the colour picture, 0 = none."""
    assert camera.depth is not None
    size, focal_px = (camera.height, camera.width), float(np.sqrt(camera.depth.fx * camera.depth.fy))
    projected = project_depth(camera, rays, depth, greatest_m)
    surface = np.full(size, np.inf)
    for corners in triangles(projected, focal_px):
        surface = np.minimum(surface, cover(size, corners, greatest_px))
    points = np.full(size, np.inf)
    for u, v, inverse_z, _ in projected[projected[..., 2] > 0]:
        x, y = int(np.floor(u + 0.5)), int(np.floor(v + 0.5))
        if 0 <= x < size[1] and 0 <= y < size[0]:
            points[y, x] = min(points[y, x], 1 / inverse_z)
    near = np.where(np.isfinite(points), points, 0)
    use_point = np.isfinite(points) & ~(surface - near <= same_surface_m(near, focal_px))
    result = np.where(use_point, points, surface)
    return np.where(result <= greatest_m, result, 0)
