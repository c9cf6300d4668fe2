"""Float64 twin of cl_kernels/light/patches.cl."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
STATIC, AGREEMENT, CLIPPED, DARKEST, ALL_CLIPPED, CLIPPED_DEPTH_M = 1, 0.9, 0.5, 0.002, 0.9, 0.15


def gather_patches(
    positions: Floats, normals: Floats, labels: NDArray[np.uint8], radiance: Floats, step: int, tolerance_m: float
) -> tuple[Floats, Floats, Floats]:
    """places, facing, shown [rows, cols, 4] as of the kernel; positions, normals, radiance [h, w, 4]."""
    rows, cols = labels.shape[0] // step, labels.shape[1] // step
    places, facing, shown = (np.zeros((rows, cols, 4)) for _ in range(3))
    for row in range(rows):
        for col in range(cols):
            block = slice(row * step, (row + 1) * step), slice(col * step, (col + 1) * step)
            middle = row * step + step // 2, col * step + step // 2
            at, towards = positions[middle], normals[middle]
            if at[3] <= 0 or towards[3] <= 0 or labels[middle] != STATIC:
                continue
            near = np.abs((positions[block][..., :3] - at[:3]) @ towards[:3]) <= tolerance_m
            alike = normals[block][..., :3] @ towards[:3] >= AGREEMENT
            seen = radiance[block]
            on = near & alike & (positions[block][..., 3] > 0) & (labels[block] == STATIC) & (seen[..., 3] > -1)
            usable = on & (seen[..., 3] > 0)
            clipped = on & (seen[..., 3] <= 0) & (seen[..., :3].max(-1) > CLIPPED)
            if not (usable | clipped).any():
                continue
            chosen = clipped if clipped.sum() > usable.sum() else usable
            logarithms = np.log(np.maximum(seen[chosen][:, :3], DARKEST))
            normal = normals[block][on][:, :3].sum(0)
            share = clipped.sum() / (clipped.sum() + usable.sum())
            places[row, col] = *at[:3], on.mean()
            facing[row, col] = *(normal / np.linalg.norm(normal)), share
            shown[row, col] = *logarithms.mean(0), 0.0 if chosen is clipped else logarithms.mean(1).var()
    return places, facing, shown


def gather_clipped(
    positions: Floats,
    normals: Floats,
    labels: NDArray[np.uint8],
    radiance: Floats,
    step: int,
    pose: Floats,
    focal_px: tuple[float, float],
) -> tuple[Floats, Floats, Floats]:
    """The last three planes of the kernel, [rows, cols, 4] each. pose: [4, 4] of the camera in the surface's space."""
    rows, cols = labels.shape[0] // step, labels.shape[1] // step
    places, facing, shown = (np.zeros((rows, cols, 4)) for _ in range(3))
    away = positions[..., :3] - pose[:3, 3]
    distance, depth = np.linalg.norm(away, axis=-1), away @ pose[:3, 2]
    color = radiance[..., :3]
    clipped = (radiance[..., 3] <= 0) & (radiance[..., 3] > -1) & (color.max(-1) > CLIPPED)
    clipped &= (color.min(-1) >= ALL_CLIPPED * color.max(-1)) & (positions[..., 3] > 0) & (labels == STATIC)
    # A pixel whose ray is r = (x, y, 1) has the solid angle 1 / (fx fy |r|^3), and |r| is distance over depth.
    areas = distance**2 / (focal_px[0] * focal_px[1]) * (depth / np.maximum(distance, 1e-9)) ** 3
    for row in range(rows):
        for col in range(cols):
            block = slice(row * step, (row + 1) * step), slice(col * step, (col + 1) * step)
            own = clipped[block]
            if not own.any():
                continue
            own = own & (distance[block] <= distance[block][own].min() + CLIPPED_DEPTH_M)
            weights = np.where(own, areas[block], 0.0)
            total = weights.sum()
            turned = normals[block][..., :3] * (normals[block][..., 3:] > 0)
            means = [
                np.einsum("yx,yxr->r", weights, of) / total for of in (positions[block][..., :3], turned, color[block])
            ]
            places[row, col] = *means[0], total
            facing[row, col, :3], shown[row, col, :3] = means[1], means[2]
    return places, facing, shown
