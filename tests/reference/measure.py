"""Float64 twin of cl_kernels/measure.cl (thesis 5.1.1): Brown's distortion, IEC 61966-2-1, marks of usable radiance."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from protocol.frames import CameraModel

Floats = NDArray[np.float64]
BLACK, CLIPPED = 0.0015, 0.985
NO_MEASUREMENT = 65535


def linearise(camera: CameraModel, color: NDArray[Any]) -> Floats:
    """Radiance in [0, 1] of code values: linear16, or sRGB by the formula of IEC 61966-2-1."""
    if camera.color_encoding == "linear16":
        return color / 65535
    code = color / 255
    return np.where(code <= 0.04045, code / 12.92, ((code + 0.055) / 1.055) ** 2.4)


def distorted_pixels(camera: CameraModel) -> Floats:
    """[h, w, 2] where each rectified pixel lies in the distorted picture (Brown 1966, three radial terms)."""
    v, u = np.mgrid[: camera.height, : camera.width].astype(np.float64)
    if not camera.is_distorted:
        return np.stack([u, v], axis=-1)
    k1, k2, p1, p2, k3 = camera.distortion
    x, y = (u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy
    r2 = x**2 + y**2
    radial = 1 + k1 * r2 + k2 * r2**2 + k3 * r2**3
    distorted_x = x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x**2)
    distorted_y = y * radial + p1 * (r2 + 2 * y**2) + 2 * p2 * x * y
    return np.stack([camera.fx * distorted_x + camera.cx, camera.fy * distorted_y + camera.cy], axis=-1)


def is_inside(camera: CameraModel, pixels: Floats) -> NDArray[np.bool_]:
    """[...] whether pixels [..., 2] lie between the centres of the picture's outermost pixels."""
    return ((pixels >= 0) & (pixels <= (camera.width - 1, camera.height - 1))).all(-1)


def corners(camera: CameraModel, pixels: Floats, linear: Floats) -> tuple[Floats, Floats]:
    """The four neighbours [4, h, w, 3] of pixels [h, w, 2] in a picture, and their bilinear weights [4, h, w, 1]."""
    low = np.clip(np.floor(pixels), 0, (camera.width - 2, camera.height - 2)).astype(int)
    values, weights = [], []
    for dx, dy in ((0, 0), (1, 0), (0, 1), (1, 1)):
        values.append(linear[low[..., 1] + dy, low[..., 0] + dx])
        weights.append((1 - np.abs(pixels - low - (dx, dy))).prod(-1)[..., None])
    return np.array(values), np.array(weights)


def measure(
    camera: CameraModel, color: NDArray[Any], depth: NDArray[np.uint16], greatest_depth_m: float
) -> tuple[Floats, Floats]:
    """radiance [h, w, 4] (rgb, w = 1 usable, 0 black or clipped, -1 outside) and depth [h, w] in metres, 0 = none.

    Colour is bilinear in linear radiance. It is usable if it is above black and nothing it is made of is clipped.
    """
    pixels = distorted_pixels(camera)
    inside = is_inside(camera, pixels)
    kept = np.where(inside[..., None], pixels, 0)
    values, weights = corners(camera, kept, linearise(camera, color))
    rgb = (weights * values).sum(0)
    clipped = np.where(weights > 0, values, 0).max(axis=(0, 3)) >= CLIPPED
    usable = (rgb.max(-1) > BLACK) & ~clipped
    radiance = np.concatenate([rgb, usable[..., None]], axis=-1)
    radiance[~inside] = (0, 0, 0, -1)
    nearest = np.floor(kept + 0.5).astype(int)
    units = depth[nearest[..., 1], nearest[..., 0]].astype(np.float64)
    metres = units * camera.depth_scale_m
    return radiance, np.where(inside & (units != NO_MEASUREMENT) & (metres <= greatest_depth_m), metres, 0)
