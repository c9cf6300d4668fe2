"""Float64 twin of cl_kernels/light/patches.cl."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
STATIC, AGREEMENT, CLIPPED, DARKEST = 1, 0.9, 0.5, 0.002


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
