"""Float64 twin of cl_kernels/reflect.cl where nothing is in the way."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from tests.reference.sh import sh_basis

Floats = NDArray[np.float64]
RAYS, GOLDEN = 8, 2.399963


def reflected_share(roughness: float, cosine: float) -> tuple[float, float]:
    """a, b of the share a + b F0 of even light (Karis 2014)."""
    x, y, z, w = roughness * np.array([-1.0, -0.0275, -0.572, 0.022]) + [1.0, 0.0425, 1.04, -0.04]
    a = min(x * x, 2.0 ** (-9.28 * cosine)) * x + y
    return 1.04 * a + w, -1.04 * a + z


def arriving(light: Floats, normal: Floats, mirrored: Floats, spread: float, turn: float) -> Floats:
    """[3] mean over the rays of the blurred light [n, 3]."""
    bands = round(len(light) ** 0.5)
    band = np.floor(np.sqrt(np.arange(len(light))))
    kept = np.exp(-0.5 * band * (band + 1) * (0.5 * spread) ** 2)
    side = np.cross(mirrored, [1.0, 0, 0] if abs(mirrored[0]) < 0.7 else [0.0, 1, 0])
    side /= np.linalg.norm(side)
    other = np.cross(mirrored, side)
    k = np.arange(RAYS)
    radius, angle = np.tan(min(spread, 1.0)) * np.sqrt((k + 0.5) / RAYS), GOLDEN * k + turn
    rays = mirrored + radius[:, None] * (np.cos(angle)[:, None] * side + np.sin(angle)[:, None] * other)
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    rays = rays[rays @ normal > 0]
    seen = np.maximum(sh_basis(rays, bands) @ (kept[:, None] * light), 0)
    return np.asarray(seen.mean(axis=0) if len(rays) else np.zeros(3))


def reflect_surroundings(
    positions: Floats,
    normals: Floats,
    colors: Floats,
    materials: Floats,
    eye: Floats,
    light: Floats,
    least_gloss: float,
) -> Floats:
    """[h, w, 4]; positions, normals, colors, materials [h, w, 4]."""
    result = np.zeros(positions.shape)
    result[..., 3] = 1
    for y, x in np.ndindex(positions.shape[:2]):
        roughness, metal = materials[y, x, :2]
        if positions[y, x, 3] <= 0 or max(1 - roughness, metal) < least_gloss:
            continue
        normal = normals[y, x, :3]
        back = eye - positions[y, x, :3]
        back /= np.linalg.norm(back)
        cosine = float(np.clip(normal @ back, 0, 1))
        a, b = reflected_share(roughness, cosine)
        head_on = (1 - metal) * 0.04 + metal * colors[y, x, :3]
        gloss = np.clip((a + b * head_on) * (1 + head_on * (1 / (a + b) - 1)), 0, 1)
        mirrored = 2 * (normal @ back) * normal - back
        turn = GOLDEN * ((y & 3) * 4 + (x & 3))
        result[y, x, :3] = gloss * arriving(light, normal, mirrored, roughness**2, turn)
        result[y, x, 3] = (1 - metal) * (1 - np.clip(a + 0.04 * b, 0, 1))
    return result
