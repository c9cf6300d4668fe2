"""Float64 twin of cl_kernels/denoise.cl (thesis 5.1.1): CIE lightness, TV-L1 (Chambolle and Pock 2011), bilateral."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]
REC_709 = np.array([0.2126, 0.7152, 0.0722])
RADIUS_PX, CLOSENESS_PX = 3, 2.0


def lightness(luminance: Floats) -> Floats:
    """L* / 100 of luminance relative to white (CIE 15:2004, 8.2.1)."""
    root = np.where(luminance > (6 / 29) ** 3, np.cbrt(luminance), luminance / (3 * (6 / 29) ** 2) + 4 / 29)
    return 1.16 * root - 0.16


def luminance(lightness: Floats) -> Floats:
    """The inverse of `lightness`."""
    root = (lightness + 0.16) / 1.16
    return np.where(root > 6 / 29, root**3, 3 * (6 / 29) ** 2 * (root - 4 / 29))


def measure_lightness(radiance: Floats) -> Floats:
    """[h, w] lightness of radiance [h, w, 4], -1 where w <= 0."""
    return np.where(radiance[..., 3] > 0, lightness(radiance[..., :3] @ REC_709), -1)


def relight(radiance: Floats, wanted: Floats) -> Floats:
    """radiance [h, w, 4] with the lightness `wanted` where w > 0, its colours' ratios kept."""
    ratio = np.maximum(luminance(wanted), 0) / np.maximum(radiance[..., :3] @ REC_709, 1e-9)
    ratio = np.where(radiance[..., 3] > 0, ratio, 1)
    return radiance * np.stack([ratio, ratio, ratio, np.ones_like(ratio)], -1)


def joined(image: Floats, none: float, edge: float = np.inf) -> tuple[Bools, Bools]:
    """[h, w - 1] and [h - 1, w]: whether both neighbours are known and differ by at most `edge`."""
    valid = image > none
    right = valid[:, 1:] & valid[:, :-1] & (np.abs(np.diff(image, axis=1)) <= edge)
    return right, valid[1:] & valid[:-1] & (np.abs(np.diff(image, axis=0)) <= edge)


def gradient(u: Floats, links: tuple[Bools, Bools]) -> tuple[Floats, Floats]:
    """Forward differences along x and y between joined pixels, 0 elsewhere."""
    dx, dy = np.zeros_like(u), np.zeros_like(u)
    dx[:, :-1] = np.where(links[0], u[:, 1:] - u[:, :-1], 0)
    dy[:-1] = np.where(links[1], u[1:] - u[:-1], 0)
    return dx, dy


def divergence(px: Floats, py: Floats) -> Floats:
    """Divergence: minus the adjoint of `gradient`, for fields that are 0 where the gradient is."""
    result = px + py
    result[:, 1:] -= px[:, :-1]
    result[1:] -= py[:-1]
    return result


def energy(u: Floats, image: Floats, weight: float) -> float:
    """sum |grad u| + weight sum |u - image| of a picture without holes."""
    return float(np.hypot(*gradient(u, joined(image, -np.inf))).sum() + weight * np.abs(u - image).sum())


def tv_l1(image: Floats, iterations: int, weight: float, none: float, step: float, edge: float = np.inf) -> Floats:
    """Chambolle and Pock 2011, algorithm 1 with theta = 1, tau = step, sigma = 1 / (8 tau) (6.2.2)."""
    links = joined(image, none, edge)
    u = ahead = image.astype(np.float64)
    px, py = np.zeros_like(u), np.zeros_like(u)
    for _ in range(iterations):
        dx, dy = gradient(ahead, links)
        px, py = px + dx / (8 * step), py + dy / (8 * step)
        length = np.maximum(np.hypot(px, py), 1)
        px, py = px / length, py / length
        moved = u + step * divergence(px, py)
        difference = moved - image
        shrunk = np.sign(difference) * np.maximum(np.abs(difference) - step * weight, 0)
        u, ahead = image + shrunk, 2 * (image + shrunk) - u
    return u


def bilateral(image: Floats, reach: tuple[float, float, float], none: float) -> Floats:
    """Mean over 7 x 7 pixels, weighted by a Gaussian of distance and (1 - (difference / reach)^2)^2 up to the reach."""
    height, width = image.shape
    reaches = np.maximum(np.minimum(reach[0] + reach[1] * (image - reach[2]) ** 2, (image - none) / 2), 1e-6)
    padded = np.pad(image.astype(np.float64), RADIUS_PX, constant_values=none)
    total, weights = np.zeros((height, width)), np.zeros((height, width))
    for dy in range(2 * RADIUS_PX + 1):
        for dx in range(2 * RADIUS_PX + 1):
            other = padded[dy : dy + height, dx : dx + width]
            distance_2 = (dy - RADIUS_PX) ** 2 + (dx - RADIUS_PX) ** 2
            falling = np.maximum(1 - ((other - image) / reaches) ** 2, 0) ** 2
            weight = np.exp(-distance_2 / (2 * CLOSENESS_PX**2)) * falling
            total, weights = total + weight * other, weights + weight
    return np.where(image > none, total / np.where(weights > 0, weights, 1), none)
